"""The benchmark: its numbers belong together, its trace opens, and sizes that do not fit do not end it."""

import gc
import gzip
import json
import os
import signal

import pytest
import torch
from support.scripts import assert_told_in_one_line, run_here

from legged_torque.benchmark import measure as benchmark
from legged_torque.benchmark.measure import MemoryMeter, summarize
from legged_torque.envs import LeggedRobot, task_registry
from legged_torque.utils.config import set_by_path
from legged_torque.utils.errors import is_out_of_memory

SETTINGS = {"runner.num_steps_per_env": 3, "algorithm.num_learning_epochs": 1, "algorithm.num_mini_batches": 1}
CHANGES = [f"{key}={value}" for key, value in SETTINGS.items()]
SMALL = ["--task=a1_position", "--device=cpu", "--rounds=2", *(f"--set={change}" for change in CHANGES)]
PARTS = ("rollout", "update", "log")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """What the script prints and writes for two sizes, with a run of endurance."""
    root = tmp_path_factory.mktemp("root")
    words = [*SMALL, "--num_envs", "2", "4", "--endurance=4", f"--json={root / 'new' / 'numbers.json'}"]
    status, output, error = run_here("benchmark.py", *words, root=root)
    assert (status, error) == (0, "")
    assert [path.name for path in root.iterdir()] == ["new"]  # it leaves no run behind
    return output, json.loads((root / "new" / "numbers.json").read_text())


@pytest.fixture
def runner(tmp_path):
    """A runner that is ready to train."""
    env_cfg, train_cfg = task_registry.get_cfgs("a1_position")
    env_cfg.env.num_envs = 2
    for path, value in SETTINGS.items():
        set_by_path(train_cfg, path, value)
    env = task_registry.get_task_class("a1_position")(env_cfg, "cpu")
    runner, _ = task_registry.make_alg_runner(env, train_cfg=train_cfg, log_root=tmp_path)
    runner.claim_log_dir({})
    return runner


def test_numbers_belong_together(measured):
    """What is derived follows from the milliseconds; settings given by ``--set`` are those that were measured."""
    _, result = measured
    assert [row["num_envs"] for row in result["rows"]] == [2, 4]
    assert result["task"] == "a1_position" and result["set"] == CHANGES
    assert result["versions"]["torch"] and result["preset"] == "parallel" and result["rounds"] == 2
    for row in result["rows"]:
        assert all(row[f"{name}_ms"] > 0 for name in (*PARTS, "physics", "step", "iteration"))
        assert row["iteration_steps_per_s"] == pytest.approx(row["num_envs"] * 3 / (row["iteration_ms"] / 1000))
        assert row["iteration_over_physics"] == pytest.approx(row["iteration_ms"] / (3 * row["physics_ms"]))
        assert row["iteration_min_ms"] <= row["iteration_ms"] <= row["iteration_max_ms"]
        # with two rounds medians are means, which add up
        assert sum(row[f"{name}_ms"] for name in PARTS) == pytest.approx(row["iteration_ms"])
        assert 0 < row["build_s"] < row["startup_s"]
        assert 50 < row["peak_memory_mib"] <= row["left_memory_mib"] < 50_000  # on the CPU memory only grows


def test_table(measured):
    """The table has a line for each size, fits on a screen and says what the file says."""
    output, result = measured
    lines = output.splitlines()
    assert max(map(len, lines)) <= 140
    (head,) = (i for i, line in enumerate(lines) if line.startswith(" worlds | physics ms"))
    titles = [cell.strip() for cell in lines[head].split("|")]
    rows = [line for line in lines[head + 1 :] if "|" in line]
    assert len(rows) == 2
    for line, row in zip(rows, result["rows"], strict=True):
        cells = dict(zip(titles, (cell.strip().replace(",", "") for cell in line.split("|")), strict=True))
        assert cells["worlds"] == str(row["num_envs"])
        assert cells["steps/s"] == f"{row['iteration_steps_per_s']:.0f}"
        assert cells["peak MiB"] == f"{row['peak_memory_mib']:.0f}"
        assert cells["start-up s"] == f"{row['startup_s']:.1f}"


def test_against_an_earlier_run(measured, tmp_path):
    """Old and new numbers are printed with their ratios; a whole training is timed on demand."""
    old = measured[1]
    more = ["runner.total_steps=12", "evaluation.interval=6", "evaluation.num_samples=4"]
    (tmp_path / "old.json").write_text(json.dumps(old | {"set": CHANGES + more, "device": "a mill"}))
    words = [*SMALL, *(f"--set={change}" for change in more), "--num_envs=2", "--learn"]
    files = ["--baseline=old.json", f"--json={tmp_path / 'new.json'}"]
    status, output, error = run_here("benchmark.py", *words, *files, root=tmp_path)
    assert (status, error) == (0, "")
    assert "train.py, 12 steps: " in output
    assert "tracking 70% was not reached" in output and "tracking 75% was not reached" in output
    (new,) = json.loads((tmp_path / "new.json").read_text())["rows"]
    assert 0 < new["learn"]["start_s"] < new["learn"]["total_s"]
    notes, table = output.split("Against old.json\n")[1].split(" worlds | ")
    assert "its device was 'a mill', is 'CPU" in notes
    lines = [[cell.strip() for cell in line.split("|")] for line in table.splitlines()[1:]]
    assert [cells[1] for cells in lines][:3] == ["physics ms", "step ms", "rollout ms"] and len(lines) == 8
    ratios = {cells[1]: float(cells[4]) for cells in lines}
    assert ratios["update ms"] == pytest.approx(new["update_ms"] / old["rows"][0]["update_ms"], abs=1e-3)


def test_endurance(measured):
    """The first and the last tenth of many iterations are compared."""
    output, result = measured
    assert output.count("4 iterations in a row") == 2
    for numbers in (row["endurance"] for row in result["rows"]):
        assert numbers["iterations"] == 4
        assert numbers["slowdown"] == pytest.approx(numbers["last_ms"] / numbers["first_ms"] - 1)
        assert numbers["growth_mib"] == numbers["last_memory_mib"] - numbers["first_memory_mib"] >= 0


@pytest.mark.parametrize("name", ["trace.json", "trace.json.gz"])
def test_trace(runner, tmp_path, name):
    """The trace is JSON that has the traced iterations with their rollouts and updates; a table has the operators."""
    lines = benchmark.trace_iterations(runner, tmp_path / name)
    content = (tmp_path / name).read_bytes()
    trace = json.loads(gzip.decompress(content) if name.endswith(".gz") else content)
    names = [event.get("name", "") for event in trace["traceEvents"]]
    assert names.count("rollout") == names.count("update") == benchmark.TRACED
    assert "aten::mm" in names and any(" aten::" in line for line in lines)


def test_whole_iterations(runner, tmp_path, capsys):
    """Each timed iteration is one of training: curriculum, rollout, update, and what is logged and saved."""
    calls = {"curriculum": 0, "read": 0}

    def count(name, function):
        def counted(*args):
            calls[name] += 1
            return function(*args)

        return counted

    runner.env.update_curriculum = count("curriculum", runner.env.update_curriculum)
    runner.env.log.read = count("read", runner.env.log.read)
    numbers = []
    times = benchmark.time_iterations(runner, 2, numbers.append)
    assert calls == {"curriculum": 3, "read": 3} and numbers == [0, 1, 2]  # one more shows when the last one ended
    assert runner.current_learning_iteration == 3 and int(runner.env.total_steps) == 3 * 2 * 3
    assert len(times["iteration"]) == 2
    for i in range(2):
        assert sum(times[name][i] for name in PARTS) == pytest.approx(times["iteration"][i])
    names = {path.name.split(".")[0] for path in tmp_path.glob("*/*")}
    assert {"events", "model_3"} <= names
    assert capsys.readouterr().out == ""
    assert "collect_rollout" not in vars(runner) and "update" not in vars(runner.alg)


def test_interrupt(runner):
    """Ctrl-C, which the runner takes for a wish to stop early, ends the benchmark."""
    with pytest.raises(KeyboardInterrupt):
        benchmark.time_iterations(runner, 5, lambda number: os.kill(os.getpid(), signal.SIGINT))
    assert runner.current_learning_iteration == 1


def test_summary_by_hand():
    """Medians and ratios of made-up times."""
    times = {"rollout": [10, 12, 30], "update": [4, 5, 6], "log": [1, 1, 2], "iteration": [15, 18, 38]}
    row = summarize(times, physics=0.25, step=0.5, num_envs=100, num_steps=24)
    assert (row["rollout_ms"], row["update_ms"], row["log_ms"], row["iteration_ms"]) == (12, 5, 1, 18)
    assert row["iteration_over_physics"] == 3.0
    assert row["iteration_steps_per_s"] == pytest.approx(2400 / 0.018)


def test_size_that_does_not_fit(tmp_path, monkeypatch):
    """It has a row that says so, and the next size is measured; both give their memory back."""

    class Large(LeggedRobot):
        def reset(self):
            if self.num_envs == 3:
                raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 80.00 GiB.")
            return super().reset()

    def num_tasks():
        gc.collect()
        return sum(issubclass(type(thing), LeggedRobot) for thing in gc.get_objects())

    entry = task_registry._tasks["a1_position"]
    monkeypatch.setitem(task_registry._tasks, "a1_position", (Large, *entry[1:]))
    before = num_tasks()
    words = [*SMALL, "--num_envs", "3", "2", f"--json={tmp_path / 'numbers.json'}"]
    status, output, error = run_here("benchmark.py", *words, root=tmp_path)
    assert (status, error) == (0, "") and num_tasks() == before
    assert "      3 | does not fit in memory" in output.splitlines()
    rows = json.loads((tmp_path / "numbers.json").read_text())["rows"]
    assert [row["num_envs"] for row in rows] == [3, 2] and rows[0]["error"] and rows[1]["iteration_ms"] > 0


def test_out_of_memory():
    """The errors of torch, Warp and CUDA for it are known, also behind another one; others are not taken for it."""
    for text in ("Failed to allocate 1024 bytes on device 'cuda:0'", "CUDA error: out of memory"):
        assert is_out_of_memory(RuntimeError(text))
    try:
        try:
            raise torch.OutOfMemoryError("CUDA out of memory")
        finally:
            raise RuntimeError("operation failed due to a previous error during capture")
    except RuntimeError as error:
        assert is_out_of_memory(error)
    assert is_out_of_memory(MemoryError())
    assert not is_out_of_memory(RuntimeError("an illegal memory access was encountered"))
    assert not is_out_of_memory(ValueError("Failed to allocate"))


def test_memory_of_a_gpu(monkeypatch):
    """It is what the device has less than when the meter was created."""
    free = [1000 * 2**20]
    monkeypatch.setattr(benchmark, "prepare_device", lambda device: None)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (free[0], 2000 * 2**20))
    meter = MemoryMeter("cuda:0")
    assert meter.used() == 0
    free[0] -= 300 * 2**20
    assert meter.used() == 300


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--task=a1_positon", "unknown task 'a1_positon'; did you mean 'a1_position'?"),
        ("--num_envs 2 0", "num_envs must be from 1 to 10000000, not 0"),
        ("--rounds=0", "--rounds must be at least 1, not 0"),
        ("--endurance=-1", "--endurance must be at least 0, not -1"),
        ("--device=cup", "unknown device 'cup'; did you mean 'cpu'?"),
        ("--preset=papr", "unknown preset 'papr'; did you mean 'paper'?"),
        ("--set=sim.solver_iteration=3", "did you mean 'sim.solver_iterations'?"),
        ("--set=runner.num_step_per_env=12", "did you mean 'runner.num_steps_per_env'?"),
        ("--learn --set=evaluation.interval=0", "needs evaluations during training: evaluation.interval is 0, of 110"),
        ("--num_envs 2 4 --profile=trace.json", "--profile writes one trace: give one number of worlds"),
    ],
)
def test_mistakes(tmp_path, words, message):
    """Mistakes are refused in one line, before anything is measured."""
    result = run_here("benchmark.py", *SMALL, *words.split(), root=tmp_path)
    assert_told_in_one_line(result, message)
    assert result[1] == "" and not list(tmp_path.iterdir())
