"""Links between pages have targets, on the site as in the repository, and the site has every page."""

import re
import runpy
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
OTHERS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES = [*OTHERS, *sorted(DOCS.rglob("*.md"))]


def without_code(page):
    """A page's text without its code."""
    return re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(page):
    """The anchors of a page's headings, as GitHub and the site make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = [re.sub(r"[^\w\s-]", "", line).strip().lower() for line in re.findall(r"^#+ (.+)$", text, re.MULTILINE)]
    return {re.sub(r"\s", "-", heading) for heading in headings}


def broken_links(page):
    """Links of a page to missing files or headings, and of the site's pages to files outside of the site."""
    broken = []
    for link in re.findall(r"\]\(\s*([^)\s]+)\s*\)", without_code(page)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        file = (page.parent / path).resolve() if path else page
        is_missing = not file.is_file() or (DOCS in page.parents and DOCS not in file.parents)
        if is_missing or (anchor and anchor not in anchors(file)):
            broken.append(link)
    return broken


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links(page):
    """Every link within the repository has its file and heading."""
    assert not broken_links(page)


def test_files_that_are_named():
    """Every path in the documents exists, and a name followed by its file in parentheses is in that file."""
    wrong = []
    for page in (page for page in PAGES if page.name != "CHANGELOG.md"):
        text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
        for name, path in re.findall(r"(?:`([\w.]+)`\s+\()?`((?:[\w.]+/)+[\w.]+\.(?:py|xml|yaml|sh))`", text):
            folders = (ROOT, ROOT / "legged_torque", ROOT / "legged_torque/envs", ROOT / "resources", page.parent)
            file = next((folder / path for folder in folders if (folder / path).is_file()), None)
            if Path(path).stem in ("pup", "minidog"):  # made by the reader
                continue
            if not file or name.rpartition(".")[2] not in file.read_text("utf-8"):
                wrong.append(f"{page.name}: {name} {path}")
    assert not wrong


def test_navigation_has_every_page():
    """The site's navigation names each page of docs/ once."""
    text = (ROOT / "mkdocs.yml").read_text("utf-8")
    settings = yaml.safe_load(text.replace("!ENV ", ""))  # a value of the environment: not known to YAML alone

    def files(entry):
        return [entry] if isinstance(entry, str) else [file for part in values(entry) for file in files(part)]

    def values(entry):
        return entry.values() if isinstance(entry, dict) else entry

    assert sorted(files(settings["nav"])) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


def test_sizes():
    """Documents stay short: lines of the README and the changelog, words in all, and bytes of docs/."""
    lines = {name: len((ROOT / name).read_text("utf-8").splitlines()) for name in ("README.md", "CHANGELOG.md")}
    assert lines["README.md"] <= 120 and lines["CHANGELOG.md"] <= 100
    generated = {DOCS / page for page in runpy.run_path(str(DOCS / "reference" / "generate.py"))["PAGES"]}
    written = {*PAGES} - generated - {*DOCS.rglob("report.md")}
    assert sum(len(page.read_text("utf-8").split()) for page in written) <= 30_000
    assert sum(file.stat().st_size for file in DOCS.rglob("*") if file.is_file()) <= 3_000_000
