"""Results and exports of strangers: what does not belong together is refused, and what they hold never runs."""

import gzip
import json
import os
import shutil

import pytest
import torch
import yaml
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of
from support.strangers import Payload

from legged_torque import resource_path
from legged_torque.deploy.policy import Policy
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.deploy.simulation import Simulation
from legged_torque.paper.report.evaluations import CURVE_METRICS

# ------------------------------------------------------------------------------------------------- results


@pytest.fixture
def results(trained, tmp_path):
    """The folder of an experiment with one cell, whose files are a stranger's."""
    folder = tmp_path / "results"
    matrix = {"tasks": ["a1_position"], "environments": {"none": ["none"]}, "seeds": [1]}
    cell = folder / "a1_position-none-s1"
    shutil.copytree(trained["a1_position"], cell / "2026-01-01_00-00-00")
    (folder / "experiment.yaml").write_text(yaml.safe_dump(matrix))
    row = {"steps": 1} | {metric.name: 0.5 for metric in CURVE_METRICS}
    lines = [",".join(row), *(",".join(map(str, row.values())) for _ in range(2))]
    (cell / "2026-01-01_00-00-00" / "evaluations.csv").write_text("\n".join(lines) + "\n")
    return folder


CONFIGS = [
    {"task": "a1_position", "env": "many", "train": [1]},
    {"task": ["a"], "env": {"env": {"num_envs": "9"}}, "train": {"runner": {"num_steps_per_env": [1]}}},
    {"task": {}, "env": {"env": {"num_envs": 1e300}}, "train": {"seed": {}, "runner": 3}, "max_iterations": "x"},
    {"task": "t", "env": {}, "train": {"actor": {"class_name": "payload:run"}}, "versions": ["payload"]},
]


@pytest.mark.parametrize("number", range(len(CONFIGS)))
def test_report(results, harm, number, tmp_path):
    """A report and a figure read settings of a stranger, and take nothing of them but text and numbers."""
    (run,) = results.glob("*/*/")
    (run / "config.yaml").write_text(yaml.safe_dump(CONFIGS[number]))
    deep = "[" * 2000 + "]" * 2000
    texts = {"deep": deep, "inf": '{"metrics": {}, "steps": Infinity}', "list": '{"metrics": []}', "none": "null"}
    for name, text in texts.items():
        (run.parent / f"result_{name}.json").write_text(text)
    result = run_here("report.py", str(results), "--out=report", root=tmp_path)
    assert result[0] == 0 and result[2] == ""
    assert (tmp_path / "report" / "report.md").read_text().count("cannot be read") == len(texts)
    status, _, error = run_here("plot.py", "curves", str(run / "evaluations.csv"), "--out=curve.png", root=tmp_path)
    assert status in (0, 2) and "Traceback" not in error and error.count("\n") == (status == 2)


def test_experiment_names_other_folders(results, tmp_path):
    """Tasks and environments of an experiment name folders: a path is refused."""
    for matrix in ({"tasks": ["../../other"]}, {"environments": {"a/b": ["none"]}}, {"environments": {"a": ["/b"]}}):
        whole = {"tasks": ["a1_position"], "environments": {"none": ["none"]}, "seeds": [1]} | matrix
        (results / "experiment.yaml").write_text(yaml.safe_dump(whole))
        assert_told_in_one_line(run_here("report.py", str(results), "--out=report", root=tmp_path), "must hold names")


@pytest.mark.parametrize(
    "text",
    [
        "[" * 2000 + "]" * 2000,
        '{"task": "a", "seed": 1, "points": 5}',
        '{"task": "a", "seed": Infinity, "points": [{"steps": 1}]}',
        '{"task": {}, "seed": 1, "points": [{"steps": Infinity}]}',
        '{"task": "a", "seed": [], "points": [[]]}',
        '{"histograms": [], "settings": 1, "rms_error": {}, "standing": {}}',
    ],
)
def test_figures(tmp_path, text):
    """Figures are not drawn of JSON that is not what its script writes."""
    (tmp_path / "theirs.json").write_text(text)
    for figure in ("curves", "pretraining"):
        words = (figure, "theirs.json", "--out=figure.png")
        assert_told_in_one_line(run_here("plot.py", *words, root=tmp_path), "theirs.json'")
    assert not (tmp_path / "figure.png").exists()


def test_curves_that_are_no_text(tmp_path):
    """A compressed file that is damaged or unpacks to too much, and a field longer than any number, are reported."""
    (tmp_path / "a.csv.gz").write_bytes(b"\x1f\x8b\x08\x00" + bytes(6) + b"\xff" * 50)
    (tmp_path / "large.csv.gz").write_bytes(gzip.compress(b"\n" * 60_000_000, 1))
    (tmp_path / "a.csv").write_text("task,steps\n" + "9" * 200_000 + ",1\n")
    for name in ("a.csv.gz", "large.csv.gz", "a.csv"):
        result = run_here("plot.py", "curves", name, "--out=figure.png", root=tmp_path)
        assert_told_in_one_line(result, f"cannot read '{name}'")


def test_figure_named_like_a_folder(tmp_path):
    """A figure is not written beside a folder, under a name that was not given."""
    points = [{"steps": 1} | {metric.name: 0.5 for metric in CURVE_METRICS}]
    (tmp_path / "curve.json").write_text(json.dumps({"task": "a", "seed": 1, "points": points}))
    (tmp_path / "figures").mkdir()
    result = run_here("plot.py", "curves", "curve.json", "--out=figures", root=tmp_path)
    assert_told_in_one_line(result, "cannot write 'figures'")
    assert sorted(os.listdir(tmp_path)) == ["curve.json", "figures"]


# ------------------------------------------------------------------------------------------------- exports


@pytest.fixture(scope="module")
def exported(trained, tmp_path_factory):
    """An exported policy."""
    for package in ("onnx", "onnxruntime", "jsonschema"):
        pytest.importorskip(package, reason=f"{package} is not installed: pip install -e .[export]")
    run, folder = trained["a1_torque"], tmp_path_factory.mktemp("export") / "out"
    words = ["--task=a1_torque", "--device=cpu", f"--load_run={run}", f"--out={folder}"]
    assert run_here("export.py", *words, root=folder.parent)[0] == 0
    return folder


def swap_terms(description):
    """Two terms of the same size change places, so that all sizes fit."""
    terms = description["observations"]["terms"]
    terms[0], terms[1] = terms[1], terms[0]


def reorder_joints(description):
    """The joints from the last to the first, which no size tells."""
    description["joint_order"].reverse()


def set_entry(path, value):
    """A change of one entry by its dotted path."""
    *sections, key = path.split(".")

    def change(description):
        for section in sections:
            description = description[section]
        description[key] = value

    return change


EXPORTS = {
    "swapped terms": (swap_terms, "was exported with other observations"),
    "swapped joints": (reorder_joints, "was exported with other joint_order"),
    "another scale": (lambda d: d["actions"]["terms"][0].update(scale=5.0), "was exported with other actions"),
    "another pose": (set_entry("nominal_pose.FR_hip_joint", 0.2), "was exported with other nominal_pose"),
    "huge limits": (set_entry("torque_limits.FR_hip_joint", [-1e30, 1e30]), "torque_limits.FR_hip_joint."),
    "huge speed": (set_entry("initial_state.joint_velocity", [0.0, 1e30]), "initial_state.joint_velocity.1"),
    "huge whole number": (lambda d: d["commands"].update(lin_vel_x=[0, 10**300]), "commands.lin_vel_x.1"),
    "huger one": (lambda d: d["commands"].update(lin_vel_x=[0, 10**400]), "larger than settings are"),
    "endless steps": (
        lambda d: d["timing"].update(decimation=10**8, control_frequency=1e-6, physics_frequency=100.0),
        "timing.decimation",
    ),
    "no number": (set_entry("episode.length", float("nan")), "episode.length is not a finite number"),
    "another folder": (
        set_entry("network.file", "../out/policy.onnx"),
        "must be the name of a file in the same folder",
    ),
    "a class": (lambda d: d.update(task={"class_name": "payload:run"}), "task"),
}


@pytest.mark.parametrize("name", EXPORTS)
def test_exports(exported, harm, tmp_path, name):
    """What does not belong to the network, or to any robot, is refused by name."""
    change, told = EXPORTS[name]
    folder = shutil.copytree(exported, tmp_path / "out")
    description = yaml.safe_load((folder / "policy.yaml").read_text())
    change(description)
    (folder / "policy.yaml").write_text(yaml.safe_dump(description, sort_keys=False))
    result = run_here("sim2sim.py", str(folder), "--steps=2", "--robots=1", root=tmp_path)
    assert_told_in_one_line(result, told)
    assert result[1] == ""


def test_network_that_runs_code(exported, harm, tmp_path):
    """A pickle in place of the network is no network; the file for TorchScript is not even opened."""
    folder = shutil.copytree(exported, tmp_path / "out")
    torch.save(Payload(harm), folder / "policy.pt")
    words = [str(folder), "--steps=2", "--robots=1"]
    assert run_here("sim2sim.py", *words, root=tmp_path)[0] == 0
    torch.save(Payload(harm), folder / "policy.onnx")
    assert_told_in_one_line(run_here("sim2sim.py", *words, root=tmp_path), "is not a readable network")


def test_metrics_that_are_no_numbers(exported):
    """A simulation in which they become infinite is an error."""
    policy = Policy(exported)
    robot = MujocoRobot(resource_path(policy.description["robot"]["file"]), policy.description)
    simulation = Simulation(policy, robot, push_velocity=1e200, push_probability=1.0)
    assert "the simulation has diverged" in error_of(simulation.run, 3, 1)
