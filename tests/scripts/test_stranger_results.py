"""Results and exports of strangers: what does not belong together is refused, and what they hold never runs."""

import gzip
import shutil

import pytest
import torch
import yaml
from support.scripts import Payload, assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque import resource_path
from legged_torque.deploy.export import write_description
from legged_torque.deploy.policy import Policy
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.deploy.simulation import Simulation
from legged_torque.paper.report.evaluations import CURVE_METRICS


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
    {"task": ["a"], "env": {"env": {"num_envs": "9"}}, "train": {"runner": {"num_steps_per_env": [1]}}},
    {"task": {}, "env": "many", "train": {"seed": {}, "actor": {"class_name": "payload:run"}}, "versions": ["x"]},
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


REPORT = '{"histograms": [], "settings": 1, "rms_error": {}, "standing": {}}'


@pytest.mark.parametrize("text", ["[" * 2000 + "]" * 2000, REPORT], ids=["deep", "report"])
def test_figures(tmp_path, text):
    """Figures are not drawn of JSON that is not what its script writes."""
    (tmp_path / "theirs.json").write_text(text)
    for figure in ("curves", "pretraining"):
        words = (figure, "theirs.json", "--out=figure.png")
        assert_told_in_one_line(run_here("plot.py", *words, root=tmp_path), "theirs.json'")
    assert not (tmp_path / "figure.png").exists()


@pytest.mark.parametrize("content", [b"\n" * 60_000_000, b"", b"steps,task,seed\n"], ids=["many", "none", "header"])
def test_curves_that_are_none(tmp_path, content):
    """A compressed file does not take all of the memory, and one without evaluations is no empty figure."""
    (tmp_path / "theirs.csv.gz").write_bytes(gzip.compress(content, 1))
    result = run_here("plot.py", "curves", "theirs.csv.gz", "--out=figure.png", root=tmp_path)
    assert_told_in_one_line(result, "" if not content else "'theirs.csv.gz'")
    assert not (tmp_path / "figure.png").exists()


@pytest.fixture(scope="module")
def exported(trained, tmp_path_factory):
    """An exported policy."""
    for package in ("onnx", "onnxruntime", "jsonschema"):
        pytest.importorskip(package, reason=f"{package} is not installed: pip install -e .[export]")
    run, folder = trained["a1_torque"], tmp_path_factory.mktemp("export") / "out"
    words = ["--task=a1_torque", "--device=cpu", f"--load_run={run}", f"--out={folder}"]
    assert run_here("export.py", *words, root=folder.parent)[0] == 0
    return folder


def test_codes_of_terminals(exported, tmp_path):
    """What a description is called does not clear the screen."""
    folder = shutil.copytree(exported, tmp_path / "out")
    description = yaml.safe_load((folder / "policy.yaml").read_text())
    description["task"] = description["training"]["run"] = "\x1b[2J\x9b2J\n"
    write_description(folder, description)
    status, output, _ = run_here("sim2sim.py", str(folder), "--steps=2", "--robots=1", root=tmp_path)
    assert status == 0 and output.replace("\n", "").isprintable() and output.startswith(r"\x1b[2J\x9b2J\n, model_1.pt")


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
