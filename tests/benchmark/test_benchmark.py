"""The benchmark: consistent numbers, and sizes that do not fit into memory."""

import gc
import json
import os
import signal

import pytest
import torch
from support.scripts import assert_told_in_one_line, run_here
from support.settings import build_runner

from legged_torque.benchmark import measure as benchmark
from legged_torque.envs import LeggedRobot, task_registry
from legged_torque.utils.errors import is_out_of_memory

SETTINGS = {"runner.num_steps_per_env": 3, "algorithm.num_learning_epochs": 1, "algorithm.num_mini_batches": 1}
CHANGES = [f"{key}={value}" for key, value in SETTINGS.items()]
SMALL = ["--task=a1_position", "--device=cpu", "--rounds=2", *(f"--set={change}" for change in CHANGES)]
PARTS = ("rollout", "update", "log")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Output and file of the script for two sizes."""
    root = tmp_path_factory.mktemp("root")
    words = [*SMALL, "--num_envs", "2", "4", f"--json={root / 'new' / 'numbers.json'}"]
    status, output, error = run_here("benchmark.py", *words, root=root)
    assert (status, error) == (0, "")
    assert [path.name for path in root.iterdir()] == ["new"]  # it leaves no run behind
    return output, json.loads((root / "new" / "numbers.json").read_text())


@pytest.fixture
def runner(make_task, tmp_path):
    """A runner that is ready to train."""
    runner = build_runner(make_task, "a1_position", 2, log_root=tmp_path, **SETTINGS)
    runner.claim_log_dir({})
    return runner


def test_mistakes(tmp_path):
    """They are refused before anything is measured, and nothing is written."""
    words = ("--num_envs=8", "--set=env.num_envs=4")
    message = "--num_envs and --set env.num_envs cannot be given together"
    assert_told_in_one_line(run_here("benchmark.py", *SMALL, *words, root=tmp_path), message)
    assert not list(tmp_path.iterdir())


def test_numbers_belong_together(measured):
    """Derived numbers follow from the milliseconds; settings given by ``--set`` were measured."""
    _, result = measured
    assert [row["num_envs"] for row in result["rows"]] == [2, 4]
    assert result["task"] == "a1_position" and result["set"] == CHANGES
    assert result["versions"]["torch"] and result["preset"] == "parallel" and result["rounds"] == 2
    for row in result["rows"]:
        assert all(row[f"{name}_ms"] > 0 for name in (*PARTS, "physics", "step", "iteration"))
        assert row["iteration_steps_per_s"] == pytest.approx(row["num_envs"] * 3 / (row["iteration_ms"] / 1000))
        assert row["iteration_min_ms"] <= row["iteration_ms"] <= row["iteration_max_ms"]
        # with two rounds medians are means, which add up
        assert sum(row[f"{name}_ms"] for name in PARTS) == pytest.approx(row["iteration_ms"])
        assert 50 < row["peak_memory_mib"] <= row["left_memory_mib"] < 50_000  # on the CPU memory only grows


def test_learner_that_collects_first(tmp_path):
    """Iterations of FlashSAC are timed from its first update on."""
    sizes = {"buffer_min_length": 24, "replay_buffer_size": 100, "mini_batch_size": 4, "critic.hidden_dim": 64}
    words = [f"--set=flashsac.{name}={size}" for name, size in sizes.items()]
    words += ["--task=a1_position", "--preset=flashsac", "--num_envs=4", "--set=runner.num_steps_per_env=2"]
    status, _, error = run_here(
        "benchmark.py", *words, "--device=cpu", "--rounds=1", f"--json={tmp_path}/out.json", root=tmp_path
    )
    assert (status, error) == (0, "")
    (row,) = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert row["update_ms"] > 0


def test_whole_iterations(runner, tmp_path, capsys):
    """Each timed iteration is one of training, with its log and checkpoint."""
    numbers = []
    times = benchmark.time_iterations(runner, 2, numbers.append)
    assert numbers == [0, 1, 2]  # one more shows when the last one ended
    assert runner.current_learning_iteration == 3 and int(runner.env.total_steps) == 3 * 2 * 3
    for i in range(2):
        assert sum(times[name][i] for name in PARTS) == pytest.approx(times["iteration"][i])
    names = {path.name.split(".")[0] for path in tmp_path.glob("*/*")}
    assert {"events", "model_3"} <= names
    assert capsys.readouterr().out == ""


def test_interrupt(runner):
    """Ctrl-C, at which a training would stop early, ends the benchmark."""
    with pytest.raises(KeyboardInterrupt):
        benchmark.time_iterations(runner, 5, lambda number: os.kill(os.getpid(), signal.SIGINT))
    assert runner.current_learning_iteration == 1


def test_size_that_does_not_fit(tmp_path, monkeypatch):
    """It has a row that says so, and the next size is measured; both give their memory back."""

    class Large(LeggedRobot):
        def reset(self):
            if self.num_envs == 3:
                raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 80.00 GiB.")
            return super().reset()

    def num_tasks():
        gc.collect()
        return sum(type(thing) is Large for thing in gc.get_referrers(Large))

    entry = task_registry._tasks["a1_position"]
    monkeypatch.setitem(task_registry._tasks, "a1_position", (Large, *entry[1:]))
    words = [*SMALL, "--num_envs", "3", "2", f"--json={tmp_path / 'numbers.json'}"]
    status, output, error = run_here("benchmark.py", *words, root=tmp_path)
    assert (status, error) == (0, "") and num_tasks() == 0
    assert "      3 | does not fit in memory" in output.splitlines()
    rows = json.loads((tmp_path / "numbers.json").read_text())["rows"]
    assert [row["num_envs"] for row in rows] == [3, 2] and rows[0]["error"] and rows[1]["iteration_ms"] > 0


def test_out_of_memory():
    """The errors of torch, Warp and CUDA for it are recognized, also behind another one; others are not."""
    for text in ("Failed to allocate 1024 bytes on device 'cuda:0'", "CUDA error: out of memory"):
        assert is_out_of_memory(RuntimeError(text))
    behind = RuntimeError("operation failed due to a previous error during capture")
    behind.__context__ = torch.OutOfMemoryError("CUDA out of memory")
    assert is_out_of_memory(behind) and is_out_of_memory(MemoryError())
    assert not is_out_of_memory(RuntimeError("an illegal memory access was encountered"))
    assert not is_out_of_memory(ValueError("Failed to allocate"))
