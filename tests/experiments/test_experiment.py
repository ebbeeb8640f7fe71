"""Experiments with the real scripts, in processes of their own: what is missing is run, what is done is skipped.

Order, failures, locks and signals are those of test_experiment_run.py, with small stand-ins in the place of scripts.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from support.experiments import SMALL, experiment_here, wait_for, write
from support.scripts import ROOT, assert_told_in_one_line, contents
from support.settings import error_of
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged_torque.experiments.matrix import read_matrix
from legged_torque.utils.policies import POLICIES_DIR
from legged_torque.utils.runs import checkpoint_numbers

TABLES = yaml.safe_load(Path(__file__).with_name("mistakes.yaml").read_text("utf-8"))
WATCHED = """
import runpy, sys
from legged_torque.experiments.local_launcher import LocalLauncher
start = LocalLauncher.start
def watched(*arguments):
    torch, context = map(sys.modules.get, ("torch", "warp._src.context"))
    print("initialized:", bool(torch and torch.cuda.is_initialized()), context and context.runtime, flush=True)
    return start(*arguments)
LocalLauncher.start = watched
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Runs a script, and tells what it has initialized when it starts a training."""


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """A smoke experiment that was killed in the middle of its training: its file, its folder, its output."""
    values = yaml.safe_load((ROOT / "experiments" / "smoke.yaml").read_text())
    values["train"] |= {"runner.total_steps": 16 * 32, "runner.save_interval": 2, "evaluation.interval": 0}
    values |= {"tasks": ["a1_torque_multihead"], "environments": {"low": ["high"]}}
    tmp_path = tmp_path_factory.mktemp("killed")
    file, out = write(tmp_path / "smoke.yaml", values), tmp_path / "out"
    command = [sys.executable, "-c", WATCHED, ROOT / "scripts" / "experiment.py"]
    command += [file, f"--out={out}", "--device=cpu"]
    with open(tmp_path / "output", "w") as output:
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(
            command, stdout=output, stderr=subprocess.STDOUT, env=environment, start_new_session=True
        )
    wait_for(lambda: list(out.glob("*/*/model_[1-9]*.pt")))
    os.killpg(process.pid, signal.SIGKILL)  # the training is asked to stop by the system
    process.wait()
    cell = out / "a1_torque_multihead-low-s1"
    wait_for(lambda: "Stopping after this iteration and saving" in (cell / "train.log").read_text())
    return file, out, (tmp_path / "output").read_text()


@pytest.fixture(scope="module")
def finished(killed, tmp_path_factory):
    """The same experiment after the same command once more: its file, its folder and what was printed."""
    file, out, _ = killed
    words = [file, f"--out={out}", "--device=cpu"]
    status, output, error = experiment_here(*words, tmp_path=tmp_path_factory.mktemp("root"))
    assert (status, error) == (0, ""), output + error
    return file, out, output


def test_no_device_is_touched(killed):
    """Reading a matrix and choosing workers starts neither CUDA nor Warp: GPUs belong to the trainings."""
    assert "initialized: False None\n" in killed[2]


def test_killed_in_the_middle_of_training(finished):
    """The training saves what it has; the next call goes on from there, to the right number of iterations."""
    _, out, _ = finished
    first, second = sorted(path for path in (out / "a1_torque_multihead-low-s1").iterdir() if path.is_dir())
    last = max(checkpoint_numbers(first))
    assert 2 <= last < 16
    state = torch.load(second / "model_16.pt", weights_only=True)
    assert (state["iter"], state["infos"]["total_timesteps"]) == (16, 16 * 32)
    assert yaml.safe_load((second / "config.yaml").read_text())["max_iterations"] == 16
    events = EventAccumulator(str(second)).Reload()
    assert [event.step for event in events.Scalars("Loss/value")] == list(range(last, 16))


def test_smoke_experiment_runs_to_the_end(finished):
    """There is a result for each evaluation, a line for each step, and a log for each cell."""
    _, out, output = finished
    cell = out / "a1_torque_multihead-low-s1"
    result = json.loads((cell / "result_high.json").read_text())
    assert (result["task"], result["perturbation"]) == ("a1_torque_multihead", "high")
    assert (result["checkpoint"], result["num_envs"], result["num_steps"]) == ("model_16.pt", 4, 20)
    log = (cell / "train.log").read_text()
    assert log.count("scripts/train.py") == 2 and log.count(" --resume") == 1 and "iteration 16 of 16, " in log
    assert f"{cell.name}: evaluation in high on cpu took" in output and not list(cell.glob("*.part"))
    assert "1 of 1 cells done" in output and output.endswith("1 of 1 cells are done.\n")


def test_what_is_done_is_not_done_again(finished, tmp_path):
    """The same command again changes nothing."""
    file, out, _ = finished
    before = contents(out)
    status, output, error = experiment_here(file, f"--out={out}", "--device=cpu", tmp_path=tmp_path)
    assert (status, error, contents(out)) == (0, "", before)
    first, spent, last = output.splitlines()
    assert (first, last) == (f"1 of 1 cells are done in {out}", "1 of 1 cells are done.")
    assert " of CPU time for training; 512 steps of training, " in spent


CELLS = {"paper": 210, "hard": 70, "low": 12, "smoke": 2, "rough": 16, "robustness": 35, "robots": 36, "table_ii": 20}


@pytest.mark.parametrize(("name", "cells"), CELLS.items())
def test_dry_run(name, cells, tmp_path):
    """The experiments of this repository are valid; ``--dry-run`` lists their cells and touches nothing."""
    out = Path("/proc/out")  # where nobody may write
    file = ROOT / "experiments" / f"{name}.yaml"
    status, output, error = experiment_here(file, f"--out={out}", "--dry-run", "--device=cpu", tmp_path=tmp_path)
    assert (status, error) == (0, "") and not out.exists()
    assert len(output.splitlines()) == cells
    assert output.count(", rough ground\n") == (16 if name == "rough" else 0)
    assert output.count(", sweep of push_velocity, ") == (cells if name.startswith("rob") else 0)
    assert ("a1_multihead-high_frequency-s4: train, evaluate in high_frequency, doubled" in output) == (name == "paper")


@pytest.mark.parametrize(("change", "message"), TABLES["file"])
def test_mistakes_in_the_file(change, message, tmp_path):
    """A key, name or value that makes no sense is refused in one line with exit status 2, and nothing is written."""
    file = write(tmp_path / "matrix.yaml", SMALL | change)
    result = experiment_here(file, f"--out={tmp_path / 'out'}", "--device=cpu", tmp_path=tmp_path)
    assert_told_in_one_line(result, message)
    assert list(tmp_path.iterdir()) == [file]


def test_teachers_in_the_file(tmp_path):
    """What training would refuse is refused before: no teacher, none that exists, of another task, and no rollout."""
    teacher, length = str(POLICIES_DIR / "a1" / "position"), "distillation.gradient_length"
    fitting = {"tasks": ["a1_position"], "preset": "student"}
    for changes, teachers, message in (
        ({}, [], "a student needs teachers"),
        ({}, ["nobody"], "there is no run with a checkpoint in"),
        ({"tasks": SMALL["tasks"]}, [teacher], "is of task 'a1_position', not 'a1_torque'"),
        ({"train": {length: 7}}, [teacher], f"{length} must divide runner.num_steps_per_env, 24, not be 7"),
        ({}, [teacher], ""),
    ):
        train = {"distillation.teachers": teachers, **changes.get("train", {})}
        file = write(tmp_path / "matrix.yaml", SMALL | fitting | changes | {"train": train})
        assert message in (error_of(read_matrix, file) if message else read_matrix(file).preset)


@pytest.mark.parametrize(("words", "message"), TABLES["command line"])
def test_mistakes_in_the_command_line(words, message, tmp_path):
    """They are refused in one line, too."""
    texts = {"file": yaml.safe_dump(SMALL), "broken": "tasks: ["}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    words = [word.format(**{name: tmp_path / name for name in texts}) for word in words]
    assert_told_in_one_line(experiment_here(*words, f"--out={tmp_path / 'out'}", tmp_path=tmp_path), message)
    assert not (tmp_path / "out").exists()


def test_conditions_of_trainings_with_a_curriculum(tmp_path):
    """A condition may hold the command: evaluations have no curriculum of commands."""
    values = {"train": {"commands.curriculum": True}, "conditions": {"stand": {"commands.fixed": [0.0, 0.0, 0.0]}}}
    assert [*read_matrix(write(tmp_path / "matrix.yaml", SMALL | values)).conditions] == ["stand"]
