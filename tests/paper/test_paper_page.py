"""docs/paper.md: nothing of the paper is left out; tests/docs looks at names, files and links. CITATION.cff."""

import re
from pathlib import Path

import yaml

import legged_torque
from legged_torque.envs.base.reward_terms import RewardTerms

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "paper.md").read_text()


def rows(title):
    """The first cells of the table below a heading."""
    section = PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    return [line.split("|")[1].strip() for line in section.splitlines() if line.startswith("| ")]


def test_nothing_is_left_out():
    """All equations, tables, figures, sections with something to implement, and reward terms have a row."""
    numbers = {int(number) for cell in rows("Equations") for number in re.findall(r"\b\d+\b", cell)}
    assert numbers == set(range(1, 12))
    assert {"I", "II", "III"} <= set(rows("Tables"))
    assert {number for cell in rows("Figures") for number in re.findall(r"\d", cell)} == set("1234567")
    sections = " ".join(rows("Sections"))
    parts = ("II-A", "II-B", "II-C", "II-D", "II-E", "II-F", "III-A", "III-B", "III-C", "IV-A", "IV-D", "IV-E", "V")
    assert all(re.search(rf"\b{part}\b", sections) for part in parts)
    terms = re.findall(r"`RewardTerms\.(_reward_\w+)`", PAGE.partition("rows of Table III")[2].partition("## ")[0])
    assert len(terms) == len(set(terms)) == 13 and all(hasattr(RewardTerms, term) for term in terms)


def test_citation():
    """It names software, of this version and license, and the paper with its authors."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0" and citation["message"] and citation["type"] == "software"
    assert (citation["title"], citation["version"]) == ("legged_torque", legged_torque.__version__)
    paper = citation["preferred-citation"]
    assert paper["title"] == "Learning torque control for quadrupeds"
    assert [author["family-names"] for author in paper["authors"]] == ["Schmidt", "Gaumann", "Bohlinger"]
    assert citation["license"] == "BSD-3-Clause" and (ROOT / "LICENSE").read_text().startswith("BSD 3-Clause License")
