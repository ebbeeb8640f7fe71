"""Results of experiments: what is read from files, means over seeds, and tests of differences."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from support.reports import HEADER, SETTINGS, line, whole_run, write_experiment, write_part

from legged_torque.experiments.matrix import Cell, Matrix
from legged_torque.paper.metrics import PAPER_METRICS
from legged_torque.paper.report.evaluations import read_evaluations
from legged_torque.paper.report.experiment import Experiment, Training, read_experiment
from legged_torque.paper.report.report import run_problems
from legged_torque.paper.report.tables import baseline_of, estimate, holm, summarize, verdict, welch

CELL = Cell(Path("a1_torque-low-s1"), "a1_torque", "low", 1, ("low",))


def evaluations(*millions):
    """Evaluations after so many million steps."""
    return pd.DataFrame({"steps": [1_000_000 * million for million in millions]})


def test_rows_of_a_run(tmp_path):
    """Empty, nan and inf cells are NaN, a cut-off last line is left out, other unreadable lines are named."""
    file, problems = tmp_path / "evaluations.csv", []
    lines = [line(1, 0.1, height="", speed="nan"), "2000000,2,0.5,0.3", line(3, 0.3), line(4, 0.4, track_xy="x")]
    lines += [line(5, 0.5, height="inf"), line(6, 0.123)]
    file.write_text("\n".join([HEADER, *lines])[:-1])  # the last cell is 1.2 instead of 1.23
    rows = read_evaluations(file, problems)
    assert rows["steps"].tolist() == [1_000_000, 3_000_000, 5_000_000]
    assert rows["track_percentage"].tolist() == [0.1, 0.3, 0.5]
    assert rows["height"].isna().tolist() == [True, False, True] and math.isnan(rows["speed"].iloc[0])
    assert problems == [f"row {number} of '{file}' cannot be read" for number in (3, 5)]
    assert read_evaluations(tmp_path / "none.csv", problems).empty and len(problems) == 2


def test_parts_are_merged(tmp_path):
    """A later part replaces an earlier one from its first evaluation on; one without evaluations replaces nothing."""
    write_experiment(tmp_path, {"low": ["low"]}, seeds=[3], tasks=["a1_torque"])
    cell = tmp_path / "a1_torque-low-s3"
    write_part(cell / "2026-01-02_00-00-00", [line(3, 0.33), line(4, 0.44)])
    write_part(cell / "2026-01-01_00-00-00", [line(i, i / 10) for i in (1, 2, 3, 4, 5)])
    write_part(cell / "2026-01-03_00-00-00", [], max_iterations=4)
    (run,) = read_experiment(tmp_path).runs
    assert (run.rows["steps"] / 1e6).tolist() == [1, 2, 3, 4]
    assert run.rows["track_percentage"].tolist() == [0.1, 0.2, 0.33, 0.44]
    assert run.total_steps == 4_000_000 and run.is_finished(run.steps)  # what the last part was started for


def test_counted_evaluations():
    """Those from step 90 million on; of a shorter run the last 18 percent; elsewhere that of the last checkpoint."""
    run = Training(CELL, {"low": evaluations(*range(1, 111))}, {"high": evaluations(5)})
    assert (run.counted("low", 90e6)["steps"] / 1e6).tolist() == list(range(90, 111))
    run.evaluations["low"] = evaluations(*range(1, 51))
    assert (run.counted("low", 90e6)["steps"] / 1e6).tolist() == list(range(41, 51))
    assert run.counted("high", 90e6)["steps"].tolist() == [5_000_000] and run.counted("doubled", 90e6).empty
    run.evaluations["high"] = evaluations(30, 50)
    assert run.counted("high", 90e6)["steps"].tolist() == [50_000_000]  # in place of the last checkpoint


def test_finished_runs():
    """Finished is a run with less than an interval left; the last 18% count, of long runs in millions."""
    run = Training(CELL, {"low": evaluations(99, 104)})
    assert run.total_steps == 110_000_000 and not run.is_finished(104e6) and not Training(CELL).is_finished(0)
    for changes, total, start in (({}, 108, 89), ({"processes": 2}, 216, 177), ({"max_iterations": 1}, 1, 0.82)):
        run.configs.append(SETTINGS | {"max_iterations": 108} | changes)
        assert run.total_steps == total * 1e6
        assert run.is_finished((total - 4) * 1e6) and not run.is_finished((total - 5) * 1e6)
        assert Experiment(Path(), Matrix([], {}, []), [run], []).last_part() == pytest.approx(start * 1e6)
    assert Experiment(Path(), Matrix([], {}, []), [], []).last_part() == 90e6


def test_broken_files(tmp_path):
    """Files that cannot be read are named, the rest is still there; values that are not finite do not count."""
    write_experiment(tmp_path, {"low": ["low", "high"]})
    runs = [tmp_path / f"a1_position-low-s{seed}" / "2026-01-01_00-00-00" for seed in (1, 2)]
    none = {"height": ""}
    counted = [line(90, 0.5, height="nan"), line(100, 0.7, height="inf"), line(110, 0, track_percentage="", **none)]
    for run, last in zip(runs, (whole_run(0.7)[2:], counted), strict=True):
        write_part(run, [*whole_run(0.8)[:2], *last])
    (tmp_path / "a1_position-low-s1" / "result_high.json").write_text('{"task": ')
    (runs[1] / "config.yaml").write_text("walk")
    experiment = read_experiment(tmp_path)
    first, second = experiment.runs_of("a1_position", "low")
    assert first.problems == ["'a1_position-low-s1/result_high.json' cannot be read"] and first.results == {}
    assert len(second.problems) == 1 and "lacks the entries" in second.problems[0] and len(second.rows) == 5
    assert run_problems(second, 90e6)[1] == "1 of the 3 evaluations that count have no track_percentage"
    cells = summarize(experiment, 90e6).loc["low"].loc["a1_position"]
    assert cells["values"]["track_percentage"] == pytest.approx([0.7, 0.6])
    assert len(cells["values"]["height"]) == 1 and not cells["is_final"]["height"]
    assert cells["values"]["track_xy"] == pytest.approx([7.0, 4.0]) and cells["is_final"]["track_xy"]


def test_welch_by_hand():
    """Variances 1 and 4, three values each: t = -3 / sqrt(5/3), freedom (5/3)^2 / ((1/9 + 16/9) / 2) = 50/17."""
    assert welch([1, 2, 3], [3, 5, 7]) == pytest.approx(2.0 * stats.t.cdf(-3.0 / math.sqrt(5 / 3), 50 / 17))
    assert welch([1, 2, 3], [3, 5, 7]) == welch([3, 5, 7], [1, 2, 3])
    assert welch([1, 2], [1, 2]) == 1.0
    assert all(math.isnan(welch(*pair)) for pair in (([1], [1, 2]), ([], [1, 2]), ([1, 1], [1, 1])))
    assert welch([1, 1], [2, 2]) == 0.0  # as shares of 0 and 1


def test_holm_by_hand():
    """Each p value times the number of tests that are left, never less than the one before, and at most 1."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.01, math.nan, 0.6, 0.7]) == pytest.approx([0.03, math.nan, 1.0, 1.0], nan_ok=True)
    assert len(holm([])) == 0 and np.isnan(holm([math.nan])).all()


def test_estimates():
    """A quarter of the seeds at each end does not count. Between two is all; of more, numpy alone finds the same."""
    values = [9.0, 1.0, 4.0, 2.0, 100.0, 3.0, 0.0, 7.0]
    for count, middle in {1: [9], 2: [9, 1], 4: [2, 4], 5: [2, 4, 9], 8: [2, 3, 4, 7]}.items():
        assert estimate(values[:count])["iqm"] == pytest.approx(np.mean(middle))
    ends = [[estimate(values[:count])[end] for end in ("low", "high")] for count in (0, 1, 2, 2)]
    assert np.isnan([*ends[0], *ends[1], estimate([])["iqm"]]).all() and ends[2] == ends[3] == [1.0, 9.0]
    random = np.random.default_rng(1)
    samples = random.normal(size=(2, 12)).tolist()
    one, other = (np.sort(random.choice(part, (20_000, 12)), axis=1)[:, 3:-3].mean(axis=1) for part in samples)
    for found, middles in ((estimate(samples[0]), one), (estimate(*samples), one - other)):
        assert [found["low"], found["high"]] == pytest.approx(np.percentile(middles, [2.5, 97.5]), abs=0.05)


def test_comparisons():
    """Better or worse than the paper is a whole interval, or one seed's number; position control is the baseline."""
    for values, paper, signs in (([0.6, 0.8], 0.5, "✓✗"), ([0.6, 0.8], 0.65, "≈≈"), ([0.6], 0.7, "✗✓")):
        assert "".join(verdict(PAPER_METRICS[i], estimate(values), paper) for i in (0, -1)) == signs
    assert baseline_of(["b", "a"]) == "b" and baseline_of(["b", "go_position_scan", "position"]) == "go_position_scan"
    others = ["a1_torque rewards.scales.nominal_position=1", "a1_torque_position_penalty", "g1_decomposition"]
    assert baseline_of([*others, "a1_position sim.dt=1"]) == "a1_position sim.dt=1"
