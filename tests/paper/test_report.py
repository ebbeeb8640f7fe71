"""Reports: tables, figures, Markdown, and a page that is whole, escaped, and refers to nothing outside of it."""

import base64
import json
import re
from itertools import product

import pandas as pd
import pytest
import yaml
from support.reports import (
    SETTINGS,
    Page,
    line,
    run_report,
    whole_run,
    write_experiment,
    write_grounds,
    write_part,
    write_result,
    write_rows,
)
from support.scripts import assert_told_in_one_line

from legged_torque.experiments.times import write_times
from legged_torque.paper.report.evaluations import METRIC_NAMES
from legged_torque.paper.report.experiment import read_experiment
from legged_torque.paper.report.figures_curves import smoothed
from legged_torque.paper.report.report import fenced, markdown_table, missing_lines, to_html
from legged_torque.paper.report.tables import welch

EVIL = "</code></pre><script>alert(1)</script> <img src=http://evil.example/x.png> & `x` | **y** ![z](/etc/passwd)"
pytestmark = pytest.mark.usefixtures("coarse")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An experiment with hostile texts: position complete, torque with one seed, unfinished, multihead not begun."""
    folder = tmp_path_factory.mktemp("experiment") / "paper"
    write_experiment(folder)
    (folder / "experiment.yaml").write_text(f"# {EVIL}\n# ```\n" + (folder / "experiment.yaml").read_text())
    settings = {
        task: {"device_name": f"GPU {EVIL}", "env": SETTINGS["env"] | {"control": {"what": task, "same": EVIL}}}
        for task in ("a1_position", "a1_torque")
    }
    for seed, tracking in ((1, 0.7), (2, 0.8)):
        cell = folder / f"a1_position-low-s{seed}"
        write_part(cell / "2026-01-01_00-00-00", whole_run(tracking), **settings["a1_position"])
        write_result(cell, "high", tracking - 0.1)
        run = folder / f"a1_position-high_frequency-s{seed}" / "2026-01-01_00-00-00"
        write_part(run, whole_run(tracking - 0.2, cost_of_transport=0.5), **settings["a1_position"])
        rows = [line(80, 0.1), line(90, tracking - 0.4), line(110, tracking - 0.4 + 0.02 * seed)]
        write_rows(run / "evaluations_doubled.csv", rows)
    run = folder / "a1_torque-low-s1" / "2026-01-01_00-00-00"
    write_part(run, [line(i, i / 100) for i in range(10, 60, 10)], **settings["a1_torque"])
    (run.parent / "result_<script>&.json").write_text("{")
    write_times(folder / "a1_position-low-s1", {"steps": 110_000_000, "gpu training": 55.0})
    (folder / "videos").mkdir()
    for name in ("a1_torque.mp4", "a1_position.gif", "a1_other.mp4", "a1_torque.txt"):
        (folder / "videos" / name).write_bytes(name.encode())
    return folder


@pytest.fixture(scope="module")
def report(folder):
    """The folder of the report on the experiment."""
    assert run_report(folder, "--videos", folder / "videos", root=folder.parent)[0] == 0
    return folder / "report"


@pytest.fixture(scope="module")
def text(report):
    """The report as Markdown."""
    return (report / "report.md").read_text()


@pytest.fixture(scope="module")
def page(report):
    """The report's page."""
    return Page((report / "report.html").read_text())


def test_table(report):
    """One row per task, column and metric, with the paper's value and nothing where there is nothing."""
    table = pd.read_csv(report / "table.csv", dtype=str, keep_default_na=False)
    assert list(table) == ["task", "environment", "metric", "iqm", "low", "high", "seeds", "paper_mean"]
    rows = {tuple(row[:3]): row[3:] for row in table.to_numpy().tolist()}
    assert len(rows) == len(table) == 3 * 4 * len(METRIC_NAMES)
    for key, iqm, low, high, *others in (
        (("a1_position", "low", "track_percentage"), 0.75, 0.7, 0.8, "2", "0.7642"),  # of two seeds the interval is all
        (("a1_position", "doubled", "track_xy"), 3.65, 3.1, 4.2, "2", ""),  # while it trained; it tracks 0.365
        (("a1_position", "low -> high", "track_xy"), 0.65, 0.6, 0.7, "2", ""),  # of the last checkpoint
    ):
        assert list(map(float, rows[key][:3])) == pytest.approx([iqm, low, high]) and rows[key][3:] == others
    assert rows["a1_torque", "low", "track_percentage"] == ["0.5", "", "", "1", ""]
    assert rows["a1_multihead", "low", "track_percentage"] == ["", "", "", "0", "0.7669"]


def test_text(text, folder):
    """Numbers stand beside the paper's, marked if not final; test, devices and commands are named, no folder is."""
    words = " ".join(text.split())
    low, often = "≈ 0.7500 [0.7000, 0.8000] | 0.7642", "✗ 0.5500 [0.5000, 0.6000] | 0.7163"
    assert "**2 of 8 numbers" in words and "(better: 1, within: 1, worse: 6; missing or not compared: 56)" in words
    assert f"| Tracking [share] | PD | {low} | {often} |" in words
    assert "| | Default torque | 0.5000 (1) † | – | – | – |" in words  # after those of the paper
    assert "| Tracking [share] | PD | 0.6500 [0.6000, 0.7000] |" in words.partition("## In other environments")[2]
    assert "python scripts/experiment.py paper/experiment.yaml --out paper_again" in words
    assert str(folder.parent) not in words
    assert "| `env.control.what` | a1_position | a1_torque |" in text and "`env.control.same`" not in text
    assert "- 5 trainings took 0:08:12 in all" in text and "0:00:55 of GPU time" in text  # 4 x 110.5 s + 50.5 s


def test_missing_parts(text):
    """Cells without data, unfinished runs and missing evaluations are listed."""
    top = text.partition("## What is missing")[2].partition("\n## ")[0]
    assert "- `a1_multihead` in low: no data, no training has begun." in top
    assert "- `a1_torque` in low: no training has begun with seed 2." in top
    assert "not finished, 50 of 110 million steps (45%)" in top and "`a1_position`" not in top


def test_seeds_of_several_settings(tmp_path):
    """If seeds of a task were not trained with the same settings, a line names these; files lie where they may."""
    write_experiment(tmp_path, {"low": ["low"]}, tasks=("a1_position", "a1_torque"))
    for (task, seed), scale in zip(product(("a1_position", "a1_torque"), (1, 2)), (4.0, 8.0, 4.0, 4.0), strict=True):
        env = {"control": {"torque_scale": scale}, "asset": {"file": f"/home/of_{seed}/a1.xml"}}
        settings = {"env": SETTINGS["env"] | env, "train": SETTINGS["train"] | {"seed": seed}}
        write_part(tmp_path / f"{task}-low-s{seed}" / "2026-01-01_00-00-00", whole_run(0.5), **settings)
    (text,) = missing_lines(read_experiment(tmp_path), 0.0)
    assert text.startswith("`a1_position` in low: ")
    assert text.endswith(" different settings: control.torque_scale=4.0, control.torque_scale=8.0.")


@pytest.mark.parametrize(("tracking", "million"), [(0.02, 110), (0.9, 10)])
def test_comparisons_that_mean_nothing(tmp_path, tracking, million):
    """Robots that do not walk, and trainings of less than a tenth of the paper's, are compared with nobody."""
    write_experiment(tmp_path / "e", {"low": ["low"]}, seeds=(1,))
    for task in ("a1_position", "a1_torque", "a1_multihead"):  # with little cost, and less force than the weight
        rows = [line(i, tracking, collision_force=99.0, cost_of_transport=0.01) for i in (million // 2, million)]
        write_part(tmp_path / "e" / f"{task}-low-s1" / "2026-01-01_00-00-00", rows, max_iterations=million)
    assert run_report(tmp_path / "e", "--out", tmp_path / "out", root=tmp_path)[0] == 0
    text = (tmp_path / "out" / "report.md").read_text()
    assert "Nothing is compared with the paper" in text
    assert not re.findall("[✓≈✗]", text) and "0.7642" not in text
    assert f"| Tracking [share] | PD | {tracking:.4f} |" in text and "| Collision forces [N] | PD | 99.0 |" in text


def test_differences(tmp_path):
    """Method minus PD: bold if it is far beyond the seeds', also corrected for two methods; the figure comes first."""
    write_experiment(tmp_path / "e", {"low": ["low"], "high": ["high"]})
    trackings = {"a1_position-low": 0.7, "a1_torque-low": 0.5, "a1_multihead-low": 0.71}
    trackings |= {"a1_position-high": 0.7, "a1_torque-high": 0.696, "a1_multihead-high": 0.704}
    for (cell, tracking), seed in product(trackings.items(), (1, 2)):
        if (cell, seed) != ("a1_multihead-low", 2):
            part = tmp_path / "e" / f"{cell}-s{seed}" / "2026-01-01_00-00-00"
            write_part(part, whole_run(tracking + 0.001 * seed, track_angular=seed))
    assert run_report(tmp_path / "e", "--out", tmp_path / "out", root=tmp_path)[0] == 0
    text = (tmp_path / "out" / "report.md").read_text()
    rows = text.partition("\n## Differences to PD\n")[2].partition("\n## ")[0].splitlines()
    tracked = [row.split(" | ")[:3] for row in rows if row.startswith("|")]
    assert 0.025 < welch([0.701, 0.702], [0.697, 0.698]) < 0.05 and tracked[2:] == [
        ["| low", "Default torque", "**-0.2000 [-0.2010, -0.1990]**"],
        ["| ", "Multi-head", "+0.0095 †"],
        ["| high", "Default torque", "-0.0040 [-0.0050, -0.0030]"],
        ["| ", "Multi-head", "+0.0040 [+0.0030, +0.0050]"],
    ]
    assert "**-2.0000 [-2.0100, -1.9900]** | +0.0000 [-1.0000, +1.0000] | **" in text and "p = " not in text
    assert re.findall(r"!\[(.*?)\]\((.*?)\)", text)[0] == ("Differences", "differences.png")


def test_rough_ground(tmp_path):
    """Means over levels, then over seeds; a file with all tiles, a figure; missing and broken files are named."""
    folder, tasks = tmp_path / "rough", ["a1_rough_position", "a1_rough_torque_scan"]
    write_experiment(folder, {"low": ["low"]}, tasks=tasks)
    plan = yaml.safe_load((folder / "experiment.yaml").read_text()) | {"grounds": {"num_envs": 7}}
    (folder / "experiment.yaml").write_text(yaml.safe_dump(plan))
    for task, seed in ((task, seed) for task in tasks for seed in (1, 2)):
        write_part(folder / f"{task}-low-s{seed}" / "2026-01-01_00-00-00", whole_run(0.7))
    write_grounds(folder / f"{tasks[0]}-low-s1", {("pits", 0.0): 1.0, ("pits", 0.5): 0.5, ("gaps", 0.5): 0.0})
    write_grounds(folder / f"{tasks[0]}-low-s2", {("pits", 0.0): 0.5, ("pits", 0.5): 0.25, ("gaps", 0.5): 0.0})
    write_grounds(folder / f"{tasks[1]}-low-s1", {("pits", 0.0): 0.75, ("pits", 0.5): 0.25, ("gaps", 0.5): 1.0})
    (folder / f"{tasks[1]}-low-s2" / "grounds.json").write_text('{"grounds": [{}]}')
    assert run_report(folder, "--out", tmp_path / "out", root=tmp_path)[0] == 0
    text = (tmp_path / "out" / "report.md").read_text()
    assert "Table I" not in text and "## While training" in text and "![Success in low](successinlow.png)" in text
    rows = [line for line in text.splitlines() if line.startswith(("| PD, blind |", "| Default torque, scan |"))]
    assert rows[:2] == [  # 0.75 and 0.375; 0; 0.5 and 0.25
        "| PD, blind | 0.56 [0.38, 0.75] | 0.00 [0.00, 0.00] | 0.38 [0.25, 0.50] |",
        "| Default torque, scan | 0.50 (1) | 1.00 (1) | 0.67 (1) |",
    ]
    assert rows[2] == "| PD, blind" + 3 * " | 0.25 [0.25, 0.25]" + " |" and rows[6].endswith(" – | – | – |")
    assert "`a1_rough_torque_scan` in low, seed 2: 'a1_rough_torque_scan-low-s2/grounds.json' cannot be read; " in text
    assert (tmp_path / "out" / "successinlow.png").read_bytes().startswith(b"\x89PNG")
    tiles = pd.read_csv(tmp_path / "out" / "grounds.csv")
    assert len(tiles) == 9 and tiles.loc[1, ["seed", "kind", "crossed"]].tolist() == [1, "pits", 0.5]


def test_conditions_and_sweeps(tmp_path):
    """Tracking by condition, a figure and a sentence per sweep; what differs is bold, what is missing is named."""
    folder, tasks = tmp_path / "e", ["a1_position", "a1_torque", "a1_decap"]
    write_experiment(folder, {"low": ["low"]}, seeds=(1, 2, 3), tasks=tasks)
    conditions = {"noise": {}, "dead_leg": {}, "a_drop": {}}
    plan = {"sweeps": {"action_delay": {}, "push_velocity": {}}, "conditions": conditions}
    plan |= yaml.safe_load((folder / "experiment.yaml").read_text())
    (folder / "experiment.yaml").write_text(yaml.safe_dump(plan, sort_keys=False))
    for task, seed in [*product(tasks[:2], (1, 2, 3)), ("a1_decap", 1)]:
        cell, late = folder / f"{task}-low-s{seed}", 0.5 if task == "a1_torque" else 0.8
        write_part(cell / "2026-01-01_00-00-00", whole_run(0.7))
        tracking = [{"track_percentage": {"mean": mean + 0.01 * seed}} for mean in (0.8, late)]
        (cell / "condition_noise.json").write_text(json.dumps({"steps": 1, "metrics": tracking[1]}))
        parts = [{"from": float(i), "to": i + 1.0, "metrics": metrics} for i, metrics in enumerate(tracking)]
        sweep = {"parameter": "action_delay", "unit": "physics_steps", "parts": parts}
        (cell / "sweep_action_delay.json").write_text(json.dumps({"sweep": sweep}))
        nothing = {"track_percentage": {"mean": None if seed == 1 else 0.6}}  # nothing was commanded with seed 1
        if task != "a1_position":
            (cell / "condition_a_drop.json").write_text(json.dumps({"steps": 1, "metrics": nothing}))
    (folder / "a1_torque-low-s3" / "condition_dead_leg.json").write_text("{}")
    assert run_report(folder, "--out", tmp_path / "out", root=tmp_path)[0] == 0
    text = (tmp_path / "out" / "report.md").read_text()
    table = text.partition("## Other conditions")[2]
    assert "| method | noise | a_drop |" in table and "| PD | 0.820 [0.810, 0.830] | – |" in table
    assert "| Default torque | **0.520 [0.510, 0.530]** | 0.600 [0.600, 0.600] (2) |" in table  # standard error 0.008
    assert "Different from PD: Default torque in 1 of 2 parts, most at 1: **-0.300 [" in table
    assert "Not tested, for want of two seeds each: `a1_decap`." in table
    assert "![Sweep of action_delay](sweepofaction_delay.png)" in table and "![Sweep of push_velocity" not in table
    assert "`a1_torque` in low, seed 1: not evaluated: sweep of push_velocity, condition dead_leg." in text
    assert "'a1_torque-low-s3/condition_dead_leg.json' cannot be read; not evaluated: sweep of push" in text


@pytest.mark.parametrize(
    ("plan", "words", "message"),
    [
        (None, [], "there is no folder"),
        ("tasks: [", [], "experiment.yaml' is not valid YAML"),
        ("", ["--from_step=-1"], "--from_step must be at least 0, not -1.0"),
        ("", ["--videos=nowhere"], "there is no video in 'nowhere' that is named <task>.gif, <task>.mp4"),
    ],
)
def test_mistakes(tmp_path, plan, words, message):
    """A mistake is one line, with exit status 2, and nothing is written."""
    if plan is not None:
        write_experiment(tmp_path / "e")
        if plan:
            (tmp_path / "e" / "experiment.yaml").write_text(plan)
    result = run_report(tmp_path / "e", "--out", tmp_path / "out", *words, root=tmp_path)
    assert_told_in_one_line(result, message)
    assert not (tmp_path / "out").exists()


def test_running_medians():
    """A single outlier vanishes; at the ends the window holds fewer evaluations; nothing is drawn beyond an end."""
    curves = pd.DataFrame({1: [1.0, 9.0, 2.0, 3.0], 2: [1.0, 1.0, None, None]}, index=[0.0, 1.0, 2.0, 3.0])
    medians = smoothed(curves, 2.0)
    assert medians[1].tolist() == [5.0, 2.0, 3.0, 2.5] and medians[2].isna().tolist() == [False, False, True, True]


def test_tables_of_the_page(text, page):
    """The first tables compare with the paper, and the page has the cells of the Markdown, in the signs' colours."""
    tables = []
    for block in re.findall(r"(?:^\|.*\n)+", text, re.M):
        rows = [each[2:-2].split(" | ") for each in block.splitlines() if not each.startswith("| ---")]
        tables.append([[re.sub(r"`|\*\*", "", cell) for cell in row] for row in rows])
    assert page.tables == tables and len(tables) == 5
    assert re.findall(r"^## (.*)", text, re.M)[:2] == ["Table I", "Differences to PD"]
    assert page.tables[1][0] == ["metric", "method", "low", "paper", "high_frequency", "paper", "doubled", "paper"]
    assert page.tables[1][1][6:] == ["0.3650 [0.3100, 0.4200]", "–"]  # it tracks too little to be compared
    assert all(cell[:1].isdecimal() for row in page.tables[1] if row[0].startswith("Collision") for cell in row[2:4])
    assert {"better", "within", "worse", None} == set(page.kinds)


def test_the_page_is_whole(report, page):
    """It refers to nothing but itself: pictures and videos are in it, byte by byte, links lead to its own headings."""
    source, files = (report / "report.html").read_text(), {file.read_bytes() for file in report.glob("*.png")}
    assert len(files) == 6 and all(file.startswith(b"\x89PNG") for file in files)
    data = [reference.partition(",")[::2] for reference in page.references if reference.startswith("data:")]
    pictures = {base64.b64decode(content) for kind, content in data if kind == "data:image/png;base64"}
    assert pictures == files
    assert ("data:video/mp4;base64", base64.b64encode(b"a1_torque.mp4").decode()) in data
    assert ("data:image/gif;base64", base64.b64encode(b"a1_position.gif").decode()) in data
    assert len(data) == len(pictures) + 2
    links = [reference for reference in page.references if not reference.startswith("data:")]
    assert len(links) > 5 and all(f'id="{link.removeprefix("#")}"' in source for link in links)
    assert "@import" not in source and "url(" not in source and "<script" not in source


def test_texts_from_files_are_escaped(text, page):
    """They are shown as they are: none of their tags and pictures is one, and none of their fences ends the plan."""
    assert "evil.example/x.png" not in "".join(page.references)
    shown = EVIL.replace("`", "").replace("**", "")
    assert f"GPU {shown}" in page.text and f"# {EVIL}" in page.text and "result_<script>&.json" in page.text
    assert "\n````yaml\n# <" in text and "\n````\n\nTo repeat it:" in text
    assert "All settings of a1_torque" in page.text and "same: " in page.text and "All settings of" not in text


def test_markdown():
    """Marks, line breaks and fences stay what they are; the page has headings to jump to."""
    assert markdown_table([["a|b"], ["x\ny | z"]]) == "| a\\|b |\n| --- |\n| x y \\| z |"
    assert fenced("a ```` b\n", "yaml") == "`````yaml\na ```` b\n`````"
    body, headings = to_html("## A `b`\n\n`a<b` and **c & d** [e](http://f)", {})
    assert headings == {"a-b": "A `b`"} and '<h2 id="a-b">A <code>b</code></h2>' in body
    assert "<p><code>a&lt;b</code> and <strong>c &amp; d</strong> [e](http://f)</p>" in body
