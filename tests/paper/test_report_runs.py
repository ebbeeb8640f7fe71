"""Reports on runs of train.py without a plan."""

import shutil

import pytest
from support.reports import Page, line, run_report, whole_run, write_grounds, write_run

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.paper.report.experiment import read_experiment
from legged_torque.paper.report.unplanned import environment_of, ranges_of
from legged_torque.utils.config import to_dict, update_from_dict

pytestmark = pytest.mark.usefixtures("coarse")


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


def test_names_of_settings():
    """Random events and ranges are found by the settings of a run; an entry that differs makes them own."""
    for perturbation in ("none", "low", "high", "high_frequency", "doubled", "own"):
        assert environment_of(settings("no_such_task", 1, perturbation)) == perturbation
    assert [ranges_of(settings("no_such_task", 1, "low", name)) for name in ("default", "hard")] == ["default", "hard"]
    no_pushes = settings("no_such_task", 1, "none")
    no_pushes["env"]["domain_rand"]["push_velocity"] = [-0.3, 0.3]  # without effect
    assert environment_of(no_pushes) == "none"
    other = settings("no_such_task", 1, "high")
    del other["env"]["domain_rand"]["gravity"], other["env"]["noise"]  # entries that it does not have
    other["env"]["domain_rand"]["stiffness"]["add"] = [0.0, 0.0]  # without effect
    assert (environment_of(other), ranges_of(other)) == ("high", "default")
    other["env"]["domain_rand"]["foot_pos"] = {"scale": [0.5, 2.0]}
    assert ranges_of(other) == "own" and ranges_of({"task": "no_such_task", "env": "many"}) == "own"


@pytest.fixture
def logs(tmp_path):
    """Runs of two tasks as train.py leaves them, one of which was resumed, and one that cannot be read."""
    for (task, seed), tracking in {("mine", 1): 0.5, ("mine", 2): 0.6, ("other", 7): 0.4}.items():
        run = tmp_path / "logs" / task / f"2026-01-0{seed}_00-00-00"
        write_run(run, whole_run(tracking), settings(task, seed, "own"))
    first = tmp_path / "logs" / "mine" / "2026-01-03_00-00-00_wide"
    write_run(first, [line(i, 0.1) for i in (10, 60)], settings("mine", 1, "low", run_name="wide"))
    resumed = tmp_path / "logs" / "mine" / "2026-01-04_00-00-00_wide"
    write_run(resumed, whole_run(0.7)[1:], settings("mine", 1, "low", run_name="wide"))
    (tmp_path / "logs" / "bad").mkdir()
    (tmp_path / "logs" / "bad" / "config.yaml").write_text("walk")
    shutil.copytree(resumed, tmp_path / "logs" / "mine" / "2026-01-09_00-00-00.host.7.part")  # which is just being made
    return tmp_path / "logs"


def test_runs_without_a_plan(logs):
    """Each training has its place by task, run name, random events and seed; nothing that was not begun is missing."""
    experiment = read_experiment(logs)
    assert not experiment.is_planned and not experiment.is_like_paper() and experiment.ranges() == "default"
    assert experiment.plan.tasks == ["mine", "mine wide", "other"] and experiment.plan.seeds == [1, 2, 7]
    wide = experiment.runs_of("mine wide", "low")[0]
    assert (wide.rows["steps"] / 1e6).tolist() == [10, 60, 80, 90, 100, 110]
    assert not wide.problems and len(experiment.problems) == 1 and "'bad'" in experiment.problems[0]
    single = read_experiment(logs / "other" / "2026-01-07_00-00-00")
    assert [run.cell.task for run in single.runs] == ["other"] and len(single.runs[0].rows) == 5


def test_report_on_runs(logs):
    """Without --out it lies beside the runs; it names ranges and trainings, and the paper nowhere. Tiles are in it."""
    write_grounds(logs / "other" / "2026-01-07_00-00-00", {("pits", 0.0): 1.0, ("pits", 0.5): 0.5})
    status, output, _ = run_report(logs, root=logs)
    assert status == 0 and "report/report.md, report.html" in output
    text = (logs / "report" / "report.md").read_text()
    assert "| task | pits | all |\n| --- | --- | --- |\n| `mine` | – | – |\n| `other` | 0.75 (1) | 0.75 (1) |" in text
    table = next(table for table in Page((logs / "report" / "report.html").read_text()).tables if "method" in table[0])
    assert table[:4] == [
        ["metric", "method", "low", "own"],
        ["Tracking [share]", "mine", "–", "0.5500 [0.5000, 0.6000] (2)"],
        ["", "mine wide", "0.7000 (1)", "–"],
        ["", "other", "–", "0.4000 (1)"],
    ]
    assert "Table I" not in text and "no training has begun" not in text and "- the run 'bad' cannot be read: " in text


def test_runs_with_other_settings(tmp_path):
    """Runs of one task and seed that differ in settings are two, named by these; a resumed one with them stays one.

    Names have no folders of the machine. Students of other teachers are not other trainings.
    """
    for day, scale, lines in ((1, -1.0, whole_run(0.5)[:3]), (2, -2.0, whole_run(0.6)), (3, -1.0, whole_run(0.7)[3:])):
        config = settings("mine", 1, "low")
        config["env"]["rewards"]["scales"]["torques"] = scale
        config["env"]["asset"]["file"] = f"/home/me/robot{scale}.xml"
        config["train"]["distillation"] = {"teachers": [f"/home/me/run{day}/model_1.pt"]}
        config["train"]["evaluation"]["interval"] = day  # this does not change what is learned
        write_run(tmp_path / f"2026-01-0{day}_00-00-00", lines, config)
    experiment = read_experiment(tmp_path)
    names = [f"mine asset.file=robot{scale}.xml rewards.scales.torques={scale}" for scale in (-1.0, -2.0)]
    assert experiment.plan.tasks == names
    first, second = (experiment.runs_of(name, "low")[0] for name in names)
    assert len(first.rows) == len(second.rows) == 5 and len(first.configs) == 2
    (problem,) = experiment.problems  # its two teachers
    assert problem.startswith(f"{names[0]} in low, seed")


def test_a_later_run_of_fewer_steps(tmp_path):
    """It counts, as later ones do, but the longer run is named."""
    for day, million in enumerate((110, 12), 1):
        config = settings("mine", 1, "low") | {"max_iterations": million}
        write_run(tmp_path / f"2026-01-0{day}_00-00-00", [line(million // 2, 0.1), line(million, 0.2)], config)
    (training,) = read_experiment(tmp_path).runs
    (problem,) = training.problems
    assert training.steps == 12e6 and problem.startswith("'2026-01-01_00-00-00' has 110 million steps, ")


def test_files_of_one_name(tmp_path):
    """Runs whose files differ in the folder alone are several trainings, whose names have the folders."""
    files = [f"{folder}robot.xml" for folder in ("/home/me/v1/", "", "/home/me/v2/")]
    for day, file in enumerate(files, 1):
        config = settings("mine", 1, "low")
        config["env"]["asset"]["file"] = file
        write_run(tmp_path / f"2026-01-0{day}_00-00-00", whole_run(0.5), config)
    assert sorted(read_experiment(tmp_path).plan.tasks) == sorted(f"mine asset.file={file}" for file in files)
