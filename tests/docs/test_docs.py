"""Links between pages have targets, the site has every page, and reference pages agree with the code."""

import operator
import re
import runpy
from pathlib import Path

import pytest
import torch
import yaml
from support.documents import DOCS
from support.scripts import ROOT
from support.settings import build_runner
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged_torque.envs import task_registry
from legged_torque.utils.config import to_dict

OTHERS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "AGENTS.md", "SECURITY.md")]
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
    words = (re.findall(r"\S*\w\S*", page.read_text("utf-8")) for page in written)  # without bars of tables
    assert sum(map(len, words)) <= 27_900
    assert sum(file.stat().st_size for file in DOCS.rglob("*") if file.is_file()) <= 3_000_000


REFERENCE = DOCS / "reference"


@pytest.fixture(scope="module")
def generator():
    """The program that writes the pages."""
    return runpy.run_path(str(REFERENCE / "generate.py"))


def flat(values, path=""):
    """Dotted paths of nested settings; dictionaries of joints are one setting."""
    for key, value in values.items():
        is_section = isinstance(value, dict) and key not in ("default_joint_angles", "stiffness", "damping")
        is_section = is_section and path != "domain_rand." and (not path.startswith("motors.") or path == "motors.")
        is_section = is_section and key != "choices"
        yield from flat(value, f"{path}{key}.") if is_section else [f"{path}{key}"]


def test_pages_are_up_to_date(generator, monkeypatch):
    """If it fails: ``python docs/reference/generate.py``."""
    monkeypatch.chdir(REFERENCE.parents[1])  # for the paths in examples
    made = generator["pages"]()
    written = {page: (REFERENCE.parent / page).read_text("utf-8") for page in made}
    for page, text in made.items():  # line breaks of --help depend on the version of Python
        assert written[page].split() == text.split(), page


def test_every_tensor_of_a_task_is_explained(make_task):
    """Rows name attributes that a task has, with the dimensions that they say, and leave out no public tensor."""
    task, text = make_task("a1_torque_multihead"), (REFERENCE / "task.md").read_text("utf-8")
    rows = re.findall(r"^\| (`self\..*?`) \| .*? \| (.*) \|$", text, re.MULTILINE)
    named = {}
    for names, shapes in rows:
        paths = re.findall(r"`self\.([\w.]+)`", names)
        each = re.findall(r"\(([^)]*)\)", shapes)
        named |= {path: each[min(i, len(each) - 1)] if each else None for i, path in enumerate(paths)}
    for path, shape in named.items():
        value = operator.attrgetter(path)(task)
        if shape:
            assert value.dim() == len([part for part in shape.split(",") if part.strip()]), path
    tensors = {name for name, value in vars(task).items() if isinstance(value, torch.Tensor) and name[0] != "_"}
    tensors |= {"state." + name for name in vars(task.state) if isinstance(getattr(task.state, name), torch.Tensor)}
    unnamed = {name for name in tensors if "._" not in name and name.removeprefix("state.") not in named}
    assert unnamed <= {"mixing"}, unnamed


def test_every_setting_is_explained():
    """Each setting of each task has a row, and each row a meaning; those of named motors have one in their class."""
    lines = (REFERENCE / "settings.md").read_text().splitlines()
    rows = dict(re.match(r"\| `(\S+)` \| .* \| (.*) \|$", line).groups() for line in lines if line.startswith("| `"))
    assert all(rows.values()), [name for name, meaning in rows.items() if not meaning]
    for name in task_registry.names():
        for cfg in task_registry.get_cfgs(name):
            missing = set(flat(to_dict(cfg))) - rows.keys()
            assert not [path for path in missing if path.split(".")[0] != "motors" or path.split(".")[-1] not in rows]


def test_every_logged_number_is_explained(tmp_path, make_task):
    """Every number that a training logs has a row."""
    text = (REFERENCE / "logs.md").read_text()
    settings = {"evaluation.interval": 32, "evaluation.num_samples": 8}
    env = {"env.episode_length_s": 0.1}
    runner = build_runner(make_task, "a1_torque_multihead", log_root=tmp_path, env=env, **settings)
    runner.claim_log_dir({})
    runner.learn(4)
    (run,) = tmp_path.iterdir()
    events = EventAccumulator(str(run))
    events.Reload()
    tags = events.Tags()["scalars"]
    assert len(tags) > 40
    for tag in tags:
        general = re.sub(r"(Episode_Reward/|Curriculum/weight_)\w+", r"\1<term>", tag)
        assert f"`{general}`" in text, tag
