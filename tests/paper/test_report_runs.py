"""The report on experiments of one's own: runs of train.py without a plan, and environments of one's own."""

import csv

import numpy as np
import pytest
import yaml
from support.reports import HEADER, Page, line, run_script, whole_run, write_grounds

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.paper.report import figures, figures_bars, figures_curves
from legged_torque.paper.report.report_runs import environment_of, ranges_of
from legged_torque.paper.report.results import read_experiment, summarize
from legged_torque.utils.config import to_dict, update_from_dict


def settings(task, seed, perturbation, ranges="default", run_name=""):
    """The config.yaml of a run of a million steps per iteration."""
    cfg = LeggedRobotCfg()
    cfg.env.num_envs = 1000
    update_from_dict(cfg, cfg.perturbations().get(perturbation, {}))
    update_from_dict(cfg, cfg.parameter_ranges()[ranges])
    if perturbation == "own":
        cfg.domain_rand.push_robots, cfg.domain_rand.push_velocity = True, [-0.123, 0.123]
    train = {"seed": seed, "runner": {"num_steps_per_env": 1000, "run_name": run_name}, "evaluation": {"also": []}}
    return {"task": task, "env": to_dict(cfg), "train": train, "max_iterations": 110, "versions": {"torch": "2"}}


def write_run(folder, lines, config):
    """Write the folder of a run."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (folder / "evaluations.csv").write_text("\n".join([HEADER, *lines]) + "\n")


def test_names_of_settings():
    """Random events and ranges are found by what a run was trained with; an entry that differs makes them own."""
    for perturbation in ("none", "low", "high", "high_frequency", "doubled", "own"):
        assert environment_of(settings("no_such_task", 1, perturbation)) == perturbation
    assert [ranges_of(settings("no_such_task", 1, "low", name)) for name in ("default", "hard")] == ["default", "hard"]
    no_pushes = settings("no_such_task", 1, "none")
    no_pushes["env"]["domain_rand"]["push_velocity"] = [-0.3, 0.3]  # as a task has them by default
    assert environment_of(no_pushes) == "none"
    older = settings("no_such_task", 1, "high")
    del older["env"]["domain_rand"]["foot_radius_share"], older["env"]["noise"]  # entries that it does not have yet
    assert (environment_of(older), ranges_of(older)) == ("high", "default")
    older["env"]["domain_rand"]["gravity"] = [1.0, 2.0]
    assert ranges_of(older) == "own"


@pytest.fixture
def logs(tmp_path):
    """Runs of two tasks as train.py leaves them, one of which was resumed, and one that cannot be read."""
    trackings = {("mine", 1): 0.5, ("mine", 2): 0.6, ("other", 7): 0.4}
    for (task, seed), tracking in trackings.items():
        run = tmp_path / "logs" / task / f"2026-01-0{seed}_00-00-00"
        write_run(run, whole_run(tracking), settings(task, seed, "own"))
    first = tmp_path / "logs" / "mine" / "2026-01-03_00-00-00_wide"
    write_run(first, [line(i, 0.1) for i in (10, 60)], settings("mine", 1, "low", run_name="wide"))
    resumed = tmp_path / "logs" / "mine" / "2026-01-04_00-00-00_wide"
    write_run(resumed, whole_run(0.7)[1:], settings("mine", 1, "low", run_name="wide"))
    (tmp_path / "logs" / "bad").mkdir()
    (tmp_path / "logs" / "bad" / "config.yaml").write_text("walk")
    return tmp_path / "logs"


def test_runs_without_a_plan(logs):
    """Each training has its place by task, run name, random events and seed; nothing that was not begun is missing."""
    experiment = read_experiment(logs)
    assert not experiment.is_planned and not experiment.is_like_paper() and experiment.ranges() == "default"
    assert experiment.plan.tasks == ["mine", "mine wide", "other"] and experiment.plan.seeds == [1, 2, 7]
    table = summarize(experiment, 90e6)
    summary = table["own"]["mine"]["track_percentage"]
    assert summary.values == pytest.approx([0.5, 0.6]) and summary.is_final
    assert table["own"]["other"]["track_percentage"].is_final and table["own"]["mine wide"] == {}
    wide = experiment.runs_of("mine wide", "low")[0]
    assert [row["steps"] / 1e6 for row in wide.rows] == [10, 60, 80, 90, 100, 110]
    assert len(experiment.notes) == 1 and "'bad'" in experiment.notes[0]


def test_page_of_own_runs(logs, monkeypatch, capsys):
    """Without --out it lies beside the runs; it names ranges and trainings, and says nothing of the paper."""
    monkeypatch.setattr(figures, "draw_all", lambda *_: [])
    assert run_script(logs) == 0 and "report/report.md, report.html" in capsys.readouterr().out
    text = (logs / "report" / "report.md").read_text()
    page = Page((logs / "report" / "report.html").read_text())
    assert page.tables[0][0] == ["metric", "method", "low", "own"]
    assert page.tables[0][1:4] == [
        ["Track % [share]", "mine", "–", "0.5500 ± 0.0500 (2)"],
        ["", "mine wide", "0.7000 (1)", "–"],
        ["", "other", "–", "0.4000 (1)"],
    ]
    assert "default ranges" in text and "Table I" not in text and "no training has begun" not in text
    assert "| `mine wide` | low | 1 | 2026-01-04_00-00-00_wide | 110 of 110 |" in text
    assert "- the run 'bad' cannot be read: " in text
    assert len(list(csv.DictReader((logs / "report" / "table.csv").read_text().splitlines()))) == 3 * 2 * 9


def test_runs_in_doubled_alone(tmp_path, monkeypatch):
    """They have their table, although the paper trains nothing there."""
    monkeypatch.setattr(figures, "draw_all", lambda *_: [])
    write_run(tmp_path / "2026-01-01_00-00-00", whole_run(0.5), settings("mine", 1, "doubled"))
    assert run_script(tmp_path) == 0
    assert (tmp_path / "report" / "report.md").read_text().count("| Track % [share] | `mine` | 0.5000 (1) |") == 1


def test_runs_with_other_settings(tmp_path):
    """Runs of one task and seed that differ in settings are two, named by these; a resumed one with them stays one."""
    for day, scale, lines in ((1, -1.0, whole_run(0.5)[:3]), (2, -2.0, whole_run(0.6)), (3, -1.0, whole_run(0.7)[3:])):
        config = settings("mine", 1, "low")
        config["env"]["rewards"]["scales"]["torques"] = scale
        config["train"]["evaluation"]["interval"] = day  # this does not change what is learned
        write_run(tmp_path / f"2026-01-0{day}_00-00-00", lines, config)
    experiment = read_experiment(tmp_path)
    names = [f"mine rewards.scales.torques={scale}" for scale in (-1.0, -2.0)]
    assert experiment.plan.tasks == names
    first, second = (experiment.runs_of(name, "low")[0] for name in names)
    assert len(first.rows) == len(second.rows) == 5 and len(first.configs) == 2


def test_rough_ground_without_a_plan(logs):
    """What evaluate.py has measured on tiles and written beside a run as grounds.json is in the report."""
    write_grounds(logs / "other" / "2026-01-07_00-00-00", {("pits", 0.0): 1.0, ("pits", 0.5): 0.5})
    assert run_script(logs) == 0
    text = (logs / "report" / "report.md").read_text()
    assert "| task | pits | all |\n| --- | --- | --- |\n| `mine` | – | – |\n| `other` | 0.75 (1) | 0.75 (1) |" in text
    assert len((logs / "report" / "grounds.csv").read_text().splitlines()) == 3


def test_one_run(logs):
    """The folder of a single run is enough."""
    experiment = read_experiment(logs / "other" / "2026-01-07_00-00-00")
    assert [run.cell.task for run in experiment.runs] == ["other"] and len(experiment.runs[0].rows) == 5


def test_figures_of_own_runs(logs):
    """Titles tell ranges and seeds, bars have a point per seed, and no figure has a number of the paper's."""
    pytest.importorskip("matplotlib", reason="figures need matplotlib: pip install -e .[plots]")
    experiment = read_experiment(logs)
    table = summarize(experiment, 90e6)
    assert list(figures.planned_figures(experiment, table)) == [*figures.CURVES, "Metrics"]
    assert figures.conditions(experiment) == "default ranges, 1–2 seeds"
    figure = figures_bars.draw_bars(experiment, table, ["low", "own"], "Metrics (1–2 seeds)")
    points = [list(line.get_ydata()) for line in figure.axes[5].lines if line.get_marker() == "o"]
    assert points == [pytest.approx([0.5, 0.6]), pytest.approx([0.4])]


def test_running_medians():
    """A single outlier vanishes; at the ends the window is what there is of it."""
    curve = figures_curves.Curve(*map(np.array, ([0.0, 1.0, 2.0, 3.0], [1.0, 9.0, 2.0, 3.0])))
    assert curve.smoothed(2.0).values.tolist() == [5.0, 2.0, 3.0, 2.5]
