"""The report on an experiment: what it reads, sums up and writes."""

import csv
import gzip
import io
import math
import sys
from pathlib import Path

import pytest
import yaml
from support.reports import (
    ALL_METRICS,
    HEADER,
    SETTINGS,
    line,
    run_script,
    whole_run,
    write_experiment,
    write_grounds,
    write_part,
    write_result,
)

from legged_torque.experiments.matrix import Cell, Matrix
from legged_torque.paper.report import figures, figures_curves, figures_style
from legged_torque.paper.report.curves import read_rows
from legged_torque.paper.report.report import run_problems
from legged_torque.paper.report.results import CellResult, Experiment, compare, holm, read_experiment, summarize, welch
from legged_torque.paper.values import ENVIRONMENTS, PAPER_METRICS, TABLE_I, paper_value

CELL = Cell(Path("a1_torque-low-s1"), "a1_torque", "low", 1, ("low",))


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Figures of few pixels, which are drawn fast."""
    monkeypatch.setitem(figures_style.SETTINGS, "savefig.dpi", 20)


def rows_of(content):
    """Return the rows of the bytes of a CSV file as dictionaries."""
    return list(csv.DictReader(io.StringIO(content.decode())))


@pytest.fixture
def report(folder, tmp_path, monkeypatch):
    """The report on the experiment without its figures: text, table and evaluations."""
    monkeypatch.setattr(figures, "draw_all", lambda *_: [])
    assert run_script(folder, "--out", tmp_path / "out") == 0
    out = tmp_path / "out"
    evaluations = gzip.decompress((out / "evaluations.csv.gz").read_bytes())
    return (out / "report.md").read_text(), rows_of((out / "table.csv").read_bytes()), rows_of(evaluations)


# what the paper says


@pytest.fixture
def folder(tmp_path):
    """An experiment: position complete in low, torque with one seed, unfinished, and multihead not begun."""
    folder = tmp_path / "paper"
    write_experiment(folder)
    for seed, tracking in ((1, 0.7), (2, 0.8)):
        cell = folder / f"a1_position-low-s{seed}"
        write_part(cell / "2026-01-01_00-00-00", whole_run(tracking))
        write_result(cell, "high", tracking - 0.1)
        cell = folder / f"a1_position-high_frequency-s{seed}"
        write_part(cell / "2026-01-01_00-00-00", whole_run(tracking - 0.2))
        write_result(cell, "doubled", tracking - 0.3)
    write_part(folder / "a1_torque-low-s1" / "2026-01-01_00-00-00", [line(i, i / 100) for i in range(10, 60, 10)])
    return folder


def test_values_of_the_paper():
    """Table I is whole: five metrics of four models in four environments, at the places where they are printed."""
    models = dict.fromkeys(task for _, task in TABLE_I)
    assert list(TABLE_I) == [(metric.name, task) for metric in PAPER_METRICS for task in models] and len(models) == 4
    assert all(len(values) == len(ENVIRONMENTS) == 4 for values in TABLE_I.values())
    assert paper_value("a1_torque_curriculum", "low", "track_percentage") == 0.7866
    assert paper_value("a1_multihead", "doubled", "cost_of_transport") == 0.8611
    assert paper_value("a1_torque_multihead", "high_frequency", "collision_force") == 157.3
    assert paper_value("a1_position", "high", "track_angular") == 0.0122
    for missing in (("a1_torque", "low", "track_xy"), ("a1_position", "none", "track_xy"), ("a1_position", "low", "x")):
        assert paper_value(*missing) is None


# reading


def test_rows_of_a_part(tmp_path):
    """Empty and nan cells are nan, a cut-off last line is left out whatever it holds, a broken one is told."""
    file, notes = tmp_path / "evaluations.csv", []
    lines = [
        HEADER,
        line(1, 0.1, height="", speed="nan"),
        "2000000,2,0.5,0.3",
        line(3, 0.3),
        line(4, 0.4, track_xy="x"),
        line(5, 0.123),
    ]
    file.write_text("\n".join(lines)[:-1])  # the last cell is 1.2 instead of 1.23: only the missing end tells
    rows = read_rows(file, notes)
    assert [row["steps"] for row in rows] == [1_000_000, 3_000_000]
    assert math.isnan(rows[0]["height"]) and math.isnan(rows[0]["speed"]) and rows[0]["track_percentage"] == 0.1
    assert [note.split(" of ")[0] for note in notes] == ["line 3", "line 5"]
    assert read_rows(tmp_path / "none.csv", notes) == [] and len(notes) == 2


def test_parts_are_merged(tmp_path):
    """A later part replaces an earlier one from its first evaluation on; one without evaluations replaces nothing."""
    write_experiment(tmp_path, {"low": ["low"]}, seeds=[3], tasks=["a1_torque"])
    cell = tmp_path / "a1_torque-low-s3"
    write_part(cell / "2026-01-02_00-00-00", [line(3, 0.33), line(4, 0.44)])
    write_part(cell / "2026-01-01_00-00-00", [line(i, i / 10) for i in (1, 2, 3, 4, 5)])
    write_part(cell / "2026-01-03_00-00-00", [], max_iterations=4)
    (run,) = read_experiment(tmp_path).runs
    assert [(row["steps"] / 1e6, row["track_percentage"]) for row in run.rows] == [
        (1, 0.1),
        (2, 0.2),
        (3, 0.33),
        (4, 0.44),
    ]
    assert run.total_steps == 4_000_000 and run.is_finished(run.steps)  # what the last part was started for


def test_what_counts_of_a_run():
    """Evaluations from step 90 million on; of a shorter run the last 18 percent; elsewhere the result."""
    run = CellResult(CELL, {"low": [{"steps": 1e6 * million} for million in range(1, 111)]})
    run.results["high"] = {"steps": 5e6}
    assert [row["steps"] / 1e6 for row in run.counted_rows("low", 90e6)] == list(range(90, 111))
    assert [row["steps"] / 1e6 for row in run.counted_rows("low", 109e6)] == [109, 110]
    del run.rows[50:]
    assert [row["steps"] / 1e6 for row in run.counted_rows("low", 90e6)] == list(range(41, 51))
    assert run.counted_rows("high", 90e6) == [{"steps": 5e6}] and run.counted_rows("doubled", 90e6) == []
    run.rows_in["high"] = [{"steps": 30e6}, {"steps": 50e6}]
    assert run.counted_rows("high", 90e6) == [{"steps": 50e6}]  # they count in place of the result


def test_finished_runs():
    """A run is finished if less than an interval between evaluations is left; without settings it has 110 million."""
    run = CellResult(CELL, {"low": [{"steps": 99e6}, {"steps": 104e6}]}, configs=[])
    assert run.total_steps == 110_000_000 and not run.is_finished(104e6)
    run.configs.append(SETTINGS | {"max_iterations": 108})
    assert run.total_steps == 108_000_000 and run.is_finished(104e6) and not run.is_finished(103e6)
    run.configs.append(SETTINGS | {"max_iterations": 108, "processes": 2})
    assert run.total_steps == 216_000_000
    assert not CellResult(CELL).is_finished(0)


@pytest.mark.parametrize(("iterations", "start"), [(110, 90e6), (330, 271e6), (1, 1e6)])
def test_last_part(iterations, start):
    """Evaluations count in the last 18%, in whole millions of steps: from 90 of 110 million on, as in Table I."""
    runs = [CellResult(CELL, configs=[SETTINGS | {"max_iterations": number}]) for number in (1, iterations)]
    assert Experiment(Path(), Matrix([], {}, []), runs, []).last_part() == start


def test_broken_files_are_told(folder, tmp_path):
    """What cannot be read is a note, and everything else is still there; runs beside the plan are left out."""
    (folder / "a1_position-low-s1" / "result_high.json").write_text('{"task": ')
    (folder / "a1_position-low-s2" / "2026-01-01_00-00-00" / "config.yaml").write_text("walk")
    (folder / "a1_gravity-low-s1").mkdir()
    experiment = read_experiment(folder)
    assert experiment.unplanned == ["a1_gravity-low-s1"]
    first, second = experiment.runs_of("a1_position", "low")
    assert first.notes == ["'a1_position-low-s1/result_high.json' cannot be read"] and first.results == {}
    assert len(second.notes) == 1 and "lacks the entries" in second.notes[0] and len(second.rows) == 5


# statistics


def test_means_and_standard_errors(folder):
    """A seed's number is the mean of its evaluations; mean and standard error are those over the seeds."""
    table = summarize(read_experiment(folder), 90e6)
    assert list(table) == ["low", "high_frequency", "doubled", "low -> high"]
    summary = table["low"]["a1_position"]["track_percentage"]
    assert summary.values == pytest.approx([0.7, 0.8]) and summary.is_final
    assert summary.standard_error == pytest.approx(0.05)  # sqrt(0.005) / sqrt(2)
    assert table["low"]["a1_position"]["collision_force"].values == pytest.approx([7.0, 8.0])
    assert table["doubled"]["a1_position"]["track_xy"].values == pytest.approx([0.4, 0.5])
    assert table["low -> high"]["a1_position"]["track_xy"].values == pytest.approx([0.6, 0.7])
    single = table["low"]["a1_torque"]["track_percentage"]
    assert single.values == pytest.approx([0.5]) and single.standard_error is None and not single.is_final
    assert table["low"]["a1_multihead"] == {}


def test_evaluations_without_a_value(folder):
    """Values that are not finite do not count; a metric without any has no number, and the report says so."""
    file = next(folder.glob("a1_position-low-s2/*/evaluations.csv"))
    none = {"height": ""}
    counted = [line(90, 0.5, height="nan"), line(100, 0.7, height="inf"), line(110, 0, track_percentage="", **none)]
    lines = [*whole_run(0.8)[:2], *counted]
    file.write_text("\n".join([HEADER, *lines]) + "\n")
    cell = summarize(read_experiment(folder), 90e6)["low"]["a1_position"]
    assert cell["track_percentage"].values == pytest.approx([0.7, 0.6])
    assert len(cell["height"].values) == 1 and not cell["height"].is_final
    assert cell["track_xy"].values == pytest.approx([7.0, 4.0]) and cell["track_xy"].is_final
    problems = run_problems(read_experiment(folder).runs_of("a1_position", "low")[1], 90e6)
    assert problems[0] == "1 of the 3 evaluations that count have no track_percentage"


def test_compare(tmp_path):
    """The tests of a metric in a column are one family; those with one seed are not counted in it."""
    write_experiment(tmp_path, {"low": ["low"]}, seeds=[1, 2, 3])
    trackings = {"a1_position": (0.7, 0.71, 0.72), "a1_torque": (0.5, 0.52, 0.54), "a1_multihead": (0.8,)}
    for task, values in trackings.items():
        for seed, tracking in enumerate(values, start=1):
            write_part(tmp_path / f"{task}-low-s{seed}" / "2026-01-01_00-00-00", whole_run(tracking))
    cells = summarize(read_experiment(tmp_path), 90e6)["low"]
    pairs = [("a1_position", "a1_torque"), ("a1_position", "a1_multihead"), ("a1_torque", "a1_multihead")]
    p = welch([0.7, 0.71, 0.72], [0.5, 0.52, 0.54])
    assert compare(cells, "track_percentage", pairs) == [pytest.approx(p), None, None]
    assert compare(cells, "track_percentage", pairs[:1] * 2) == pytest.approx([2 * p, 2 * p])


# what is written


def test_table(report):
    """One row per task, column and metric, with the paper's value beside ours and nothing where there is nothing."""
    _, table, _ = report
    assert list(table[0]) == ["task", "environment", "metric", "mean", "standard_error", "seeds", "paper_mean"]
    rows = {(row["task"], row["environment"], row["metric"]): row for row in table}
    assert len(rows) == len(table) == 3 * 4 * len(ALL_METRICS)
    row = rows["a1_position", "low", "track_percentage"]
    assert float(row["mean"]) == pytest.approx(0.75) and float(row["standard_error"]) == pytest.approx(0.05)
    assert (row["seeds"], row["paper_mean"]) == ("2", "0.7642")
    assert float(rows["a1_position", "doubled", "track_xy"]["mean"]) == pytest.approx(0.45)
    assert rows["a1_position", "doubled", "track_xy"]["paper_mean"] == "0.1602"
    assert rows["a1_position", "low -> high", "track_xy"]["paper_mean"] == ""
    row = rows["a1_torque", "low", "track_percentage"]
    assert (row["standard_error"], row["seeds"], row["paper_mean"]) == ("", "1", "")
    row = rows["a1_multihead", "low", "track_percentage"]
    assert (row["mean"], row["standard_error"], row["seeds"], row["paper_mean"]) == ("", "", "0", "0.7669")


def test_evaluations(report):
    """All evaluations during training, in one table."""
    _, _, evaluations = report
    assert list(evaluations[0]) == ["task", "environment", "seed", "steps", "seconds", *ALL_METRICS]
    assert len(evaluations) == 4 * 5 + 5
    row = next(row for row in evaluations if row["environment"] == "high_frequency" and row["seed"] == "2")
    cells = ("task", "steps", "seconds", "track_percentage", "height")
    assert [row[name] for name in cells] == ["a1_position", "10000000", "10.5", "0.1", "1"]


def test_same_bytes_again(report, folder, tmp_path):
    """The same results give the same compressed file, so that a commit holds no change that is none."""
    assert run_script(folder, "--out", tmp_path / "again") == 0
    files = [tmp_path / name / "evaluations.csv.gz" for name in ("out", "again")]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert files[0].read_bytes()[4:8] == bytes(4)  # no time


def test_no_folder_of_this_machine(report, tmp_path):
    """Commands and notes of the report hold no absolute path."""
    text, _, _ = report
    assert str(tmp_path) not in text and "python scripts/experiment.py paper/experiment.yaml --out paper_again" in text


def test_what_is_missing(report):
    """Cells without data, unfinished runs and missing evaluations are told at the top."""
    text, _, _ = report
    top = text.partition("## What is missing")[2].partition("\n## ")[0]
    assert "- `a1_multihead` in low: no data, no training has begun." in top
    assert "- `a1_torque` in high_frequency: no data, no training has begun." in top
    assert "- `a1_torque` in low: no training has begun with seed 2." in top
    told = next(line for line in top.splitlines() if "`a1_torque` in low, seed 1" in line)
    assert "not finished, 50 of 110 million steps (45%)" in told and "its number is the mean of its last 18%" in told
    assert "not evaluated in high" in told and "`a1_position`" not in top


def test_text(report):
    """Numbers stand beside the paper's, marked where they are not final, and the test and the commands are named."""
    text, _, _ = report
    low, often = "≈ 0.7500 ± 0.0500 | 0.7642", "✗ 0.5500 ± 0.0500 | 0.7163"
    assert f"| Track % [share] | PD | {low} | {often} |" in text
    assert "|  | Default torque | 0.5000 (1) † | – | – | – |" in text  # after those of the paper
    assert "| Track % [share] | PD | 0.6500 ± 0.0500 |" in text.partition("## In other environments")[2]
    assert "over 2 seeds (how many, if not all)" in text and "PD is `a1_position`" in text
    assert "Welch's t-test" in text and "Holm's correction" in text
    assert "All pairs: no test is possible; it takes at least two seeds of two tasks." in text
    assert "NVIDIA H200" in text and "python 3.11.0, torch 2.11.0" in text
    assert "python scripts/experiment.py" in text and "python scripts/report.py" in text


def test_significant_differences(tmp_path, monkeypatch):
    """A difference far beyond the seeds' is bold, and so is the task that beats all others; tracking has to be high."""
    monkeypatch.setattr(figures, "draw_all", lambda *_: [])
    write_experiment(tmp_path / "e", {"low": ["low"]}, seeds=[1, 2, 3])
    for task, tracking in {"a1_position": 0.7, "a1_torque": 0.5, "a1_multihead": 0.6}.items():
        for seed in (1, 2, 3):
            part = tmp_path / "e" / f"{task}-low-s{seed}" / "2026-01-01_00-00-00"
            write_part(part, whole_run(tracking + 0.001 * seed))
    assert run_script(tmp_path / "e", "--out", tmp_path / "out") == 0
    text = (tmp_path / "out" / "report.md").read_text()
    assert "Nothing: all trainings and evaluations are complete." in text
    assert "| PD | ✗ **0.7020 ± 0.0006** | 0.7642 |" in text
    assert "|  | Default torque | **5.0200 ± 0.0058** | – |" in text  # its error is the smallest
    p = holm([welch([0.701, 0.702, 0.703], [0.501, 0.502, 0.503]), 0.0, 0.0])[0]
    assert p < 0.05 and "| PD − Default torque | **+0.2000, p = " in text
    assert "Against PD:" in text and "| Multi-head − PD | **-0.1000, p = " in text


def test_figures(folder, tmp_path):
    """All figures are there as PNG, and none without data."""
    pytest.importorskip("matplotlib", reason="figures need matplotlib: pip install -e .[plots]")
    assert run_script(folder, "--out", tmp_path / "out") == 0
    for name in ("figure3", "figure3overseconds", "figure5a", "figure5b", "figure6", "figure7"):
        assert (tmp_path / "out" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"({name}.png)" in (tmp_path / "out" / "report.md").read_text()
    write_experiment(tmp_path / "empty")
    assert run_script(tmp_path / "empty", "--out", tmp_path / "out2") == 0
    assert not list((tmp_path / "out2").glob("figure*"))
    assert (
        "No Figure 3, Figure 3 over seconds, Figure 5a, Figure 5b, Figure 6, Figure 7: there are no data"
        in (tmp_path / "out2" / "report.md").read_text()
    )


def test_labels_of_curves(folder):
    """A panel per environment, below which an unfinished task says how far it is; what has no data is not drawn."""
    pytest.importorskip("matplotlib", reason="figures need matplotlib: pip install -e .[plots]")
    figure = figures_curves.draw_curves(read_experiment(folder), figures.CURVES["Tracking"][1], "Figure 3")
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["PD", "Default torque"]
    notes = [axis.get_xlabel().partition("\n")[2] for axis in figure.axes]
    assert notes == ["Default torque (1 of 2 seeds, up to 50e6 steps)", ""]
    points = [line.get_ydata().tolist() for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert pytest.approx(points[0]) == [0.725, 0.825]  # of each seed, those at 100 and 110 million


def test_notes_of_curves():
    """Labels tell seeds that are missing and how far unfinished ones are."""
    note = figures_curves.progress_note
    curve = lambda end, finished: figures_curves.Curve([0.0, end], [0.0, 1.0], finished)  # noqa: E731
    assert note([curve(110, True)] * 4, 4, " s") == ""
    assert note([curve(110, True)] * 2, 4, " s") == " (2 of 4 seeds)"
    assert note([curve(60, False)] * 2, 4, "e6 steps") == " (2 of 4 seeds, up to 60e6 steps)"
    assert (
        figures_curves.progress_note([curve(110, True), curve(57, False)], 2, " s") == " (2 of 2 seeds, up to 57–110 s)"
    )


@pytest.mark.parametrize("package", ["matplotlib", "scipy.stats"])
def test_without_the_extra(folder, tmp_path, monkeypatch, capsys, package):
    """One line says what a report needs, and neither report nor tables are written."""
    monkeypatch.setitem(sys.modules, package, None)
    assert run_script(folder, "--out", tmp_path / "out") == 2
    assert capsys.readouterr().err.endswith(" need the extra: pip install 'legged_torque[plots]'\n")
    assert not list((tmp_path / "out").glob("*.[mc]*"))


@pytest.mark.parametrize(
    ("plan", "words", "message"),
    [
        (None, [], "there is no folder"),
        ("", [], "e/experiment.yaml'"),
        ("tasks: [", [], "experiment.yaml' is not valid YAML"),
        ("tasks: [a1_torque]", [], "lacks the key 'environments'"),
        ("tasks: [a]\nseeds: [1]\nenvironments: [low]", [], "'environments' must hold entries 'name: value'"),
        ("good", ["--from_step=-1"], "--from_step must be at least 0, not -1.0"),
        ("good", ["--from_steps=1"], "unknown option '--from_steps=1'; did you mean '--from_step'?"),
    ],
)
def test_mistakes(tmp_path, capsys, plan, words, message):
    """A mistake is one line, with exit status 2, and nothing is written."""
    if plan is not None:
        (tmp_path / "e").mkdir()
    if plan == "good":
        write_experiment(tmp_path / "e")
    elif plan:
        (tmp_path / "e" / "experiment.yaml").write_text(plan)
    assert run_script(tmp_path / "e", "--out", tmp_path / "out", *words) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and message in error
    assert not (tmp_path / "out").exists()


def test_rough_ground(tmp_path):
    """Means over levels, then over seeds; a file with all tiles, a figure; what is missing or broken is told."""
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
    assert run_script(folder, "--out", tmp_path / "out") == 0
    text = (tmp_path / "out" / "report.md").read_text()
    assert "Table I" not in text and "## While training" in text and "![Success in low](successinlow.png)" in text
    rows = [line for line in text.splitlines() if line.startswith(("| PD, blind |", "| Default torque, scan |"))]
    assert rows[:2] == [  # 0.75 and 0.375; 0; 0.5 and 0.25
        "| PD, blind | 0.56 ± 0.19 | 0.00 ± 0.00 | 0.38 ± 0.12 |",
        "| Default torque, scan | 0.50 (1) | 1.00 (1) | 0.67 (1) |",
    ]
    assert rows[2] == "| PD, blind | 0.25 ± 0.00 | 0.25 ± 0.00 | 0.25 ± 0.00 |" and rows[6].endswith(" – | – | – |")
    assert "`a1_rough_torque_scan` in low, seed 2: 'a1_rough_torque_scan-low-s2/grounds.json' cannot be read; " in text
    assert (tmp_path / "out" / "successinlow.png").read_bytes().startswith(b"\x89PNG")
    tiles = rows_of((tmp_path / "out" / "grounds.csv").read_bytes())
    assert len(tiles) == 9 and {row["task"] for row in tiles} == set(tasks)
    numbers = [tiles[1][key] for key in ("seed", "kind", "level", "crossed", "track_percentage")]
    assert numbers == ["1", "pits", "0.5", "0.5", "0.05"]
