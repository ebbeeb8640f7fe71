"""The scripts as a user runs them: mistakes in one line; training, stopping, resuming and playing fit together."""

import contextlib
import math
import os
import re
import resource
import signal
import subprocess
import sys
import threading

import pytest
import torch
import yaml
from support.clock import wait_for
from support.scripts import COMMAND, PATHS, ROOT, SMALL, assert_told_in_one_line, run_here
from support.settings import error_of
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged_torque import RESOURCES_DIR
from legged_torque.learning.evaluator import append_row
from legged_torque.utils.interrupt import StopRequest
from legged_torque.utils.runs import checkpoint_file, checkpoint_numbers


def start(script, *words, root, modules=ROOT):
    """Start a script in the folder ``root``, a process of its own without what the tests have set for themselves."""
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    environment |= {"PYTHONPATH": f"{modules}{os.pathsep}{PATHS['PYTHONPATH']}"}
    command = [*COMMAND, str(ROOT / "scripts" / script), *words]
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background ignores it
    try:
        return subprocess.Popen(
            command, cwd=root, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
    finally:
        signal.signal(signal.SIGINT, before)


def finish(process):
    """Wait for a process; return exit status, standard output, standard error."""
    with process:
        output, error = process.communicate(timeout=300)
    return process.returncode, output, error


def test_run_folder(root):
    """A run leaves its checkpoints, events and settings, in a folder named by its time and name."""
    (run,) = (root / "logs" / "a1_position").glob("*_good")
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_good", run.name)
    files = {path.name.split(".tfevents")[0] for path in run.iterdir() if path.is_file()}
    models = {"model_0.pt", "model_1.pt", "model_2.pt"}  # the first so that the training can be watched at once
    assert files == models | {"worlds_2.pt", "events.out", "config.yaml", "evaluations.csv"}
    config = yaml.safe_load((run / "config.yaml").read_text())
    expected = {"task": "a1_position", "preset": "laptop", "device": "cpu", "max_iterations": 2}
    assert expected.items() <= config.items() and config["env"]["env"]["num_envs"] == 2


def test_notes_on_settings_without_effect(tmp_path):
    """Ranges that nothing is drawn from, and an evaluation that begins after the end."""
    chain = ["--set=motors.chain=[delay, ideal, lag]", "--set=control.refresh_torques=false"]  # no kernel of its own
    words = [*SMALL, *chain, "--set=motors.lag.draws={time_constant: {set: [0.001, 0.003]}}", "--logger=none"]
    words += ["--set=domain_rand.gravity={set: [9.0, 9.5]}", "--set=noise.noise_scales.dof_vel=5"]
    told = ("Note: motors.lag.draws needs", "Note: evaluation.also measures nothing", "but there are 16 steps")
    told += tuple(
        f"Note: {path} has no effect without {switch}=true"
        for path, switch in (
            ("domain_rand.gravity", "domain_rand.randomize_parameters"),
            ("noise.noise_scales.dof_vel", "noise.add_noise"),
        )
    )
    for more, is_told in (([], True), (["--perturbation=low", "--set=evaluation.also_from=16"], False)):
        status, output, _ = run_here("train.py", *words, "--set=evaluation.also=[high]", *more, root=tmp_path)
        assert status == 0 and [note in output for note in told] == [is_told] * 5
        assert len(list(tmp_path.glob("logs/*/*/evaluations_high.csv"))) == (not is_told)


def test_resume_in_a_folder_by_its_path(root, tmp_path):
    """``--load_run`` takes a path, ``--checkpoint`` an earlier one; the run goes on to the iterations of its start."""
    (run,) = (root / "logs" / "a1_position").glob("*_good")
    words = [f"--load_run={run}", "--checkpoint=1", "--resume", "--logger=none", "--seed=1"]
    status, output, error = run_here("train.py", "--task=a1_position", "--device=cpu", *words, root=tmp_path)
    assert (status, error) == (0, "")
    assert f"Resuming from {run / 'model_1.pt'}, after 1 iteration.\n" in output
    (new,) = (tmp_path / "logs" / "a1_position").iterdir()
    files = {path.name for path in new.iterdir() if path.is_file()}
    assert files == {"config.yaml", "model_1.pt", "model_2.pt", "worlds_2.pt", "evaluations.csv"}
    state = torch.load(new / "model_2.pt", weights_only=True)
    assert (state["iter"], state["infos"]["total_timesteps"]) == (2, 2 * 2 * 4)
    train = yaml.safe_load((new / "config.yaml").read_text())["train"]
    assert (train["seed"], train["runner"]["logger"], train["runner"]["num_steps_per_env"]) == (1, "none", 4)


def test_resume_with_other_worlds_or_more_steps(tmp_path):
    """Without ``--max_iterations``, a resumed run makes the steps of its settings, whatever an iteration has."""
    words = [*SMALL[:-1], "--set=runner.total_steps=16", "--set=runner.save_interval=1", "--logger=none"]
    assert run_here("train.py", *words, root=tmp_path)[0] == 0
    (run,) = (tmp_path / "logs" / "a1_position").iterdir()

    def resumed(run, checkpoint, change):
        """The run that goes on from a checkpoint, its iterations and steps."""
        before = set(run.parent.iterdir())
        words = ["--device=cpu", f"--load_run={run}", f"--checkpoint={checkpoint}", "--resume", change]
        assert run_here("train.py", *words, f"--run_name={len(before)}", root=tmp_path)[0] == 0
        (new,) = set(run.parent.iterdir()) - before
        state = torch.load(new / "model_3.pt", weights_only=True)
        return new, state["iter"], state["infos"]["total_timesteps"]

    fewer, *numbers = resumed(run, 1, "--num_envs=1")
    assert numbers == [3, 16]
    assert resumed(fewer, 2, "--num_envs=2")[1:] == (3, 20)  # from 12 steps on
    assert resumed(run, 1, "--set=runner.total_steps=24")[1:] == (3, 24)


def test_teachers_by_their_names(run):
    """They are found in a training, when it is resumed, which keeps whole paths, and in a benchmark."""
    root, config = run.parents[2], run / "config.yaml"
    config.write_text(config.read_text().replace("action_scale: 0.25", "action_scale: 0.2"))
    new = ["--preset=student", "--set=distillation.gradient_length=4", "--set=distillation.num_mini_batches=2"]
    words = {"train.py": [*SMALL, *new], "benchmark.py": ["--num_envs=2", "--rounds=1", *SMALL[:2], *new, SMALL[3]]}
    for script in words:
        teachers = f"--set=distillation.teachers=[{run.name}]"
        assert run_here(script, *words[script], teachers, root=root)[::2] == (0, "")
    for number, teacher in enumerate((run.name, run.relative_to(root)), 3):
        resume = ["--resume", f"--max_iterations={number}", f"--set=distillation.teachers=[{teacher}]"]
        assert run_here("train.py", *SMALL[:2], *resume, root=root)[::2] == (0, "")
        settings = yaml.safe_load((max(run.parent.iterdir()) / "config.yaml").read_text())
        assert settings["train"]["distillation"]["teachers"] == [str(run / "model_1.pt")]


def test_nobody_reads_on(tmp_path):
    """Output that goes into ``| head`` ends a script without a traceback."""
    process = start("train.py", "--list", root=tmp_path)
    process.stdout.close()
    assert (process.stderr.read(), process.wait()) == ("", 1)
    process.stderr.close()


def test_interrupt_while_starting(tmp_path):
    """Ctrl-C before anything runs ends a script by that signal, without a word."""
    modules, root = tmp_path / "modules", tmp_path / "root"
    modules.mkdir()
    root.mkdir()
    endless = "import pathlib, time\npathlib.Path(__file__).with_name('begun').touch()\ntime.sleep(600)\n"
    (modules / "torch.py").write_text(endless)  # its import lasts until the signal
    process = start("train.py", *SMALL, root=root, modules=modules)
    wait_for((modules / "begun").exists)
    process.send_signal(signal.SIGINT)
    assert finish(process) == (-signal.SIGINT, "", "") and not list(root.iterdir())


def test_train_stop_resume_play(tmp_path):
    """Ctrl-C saves and ends with status 130, resuming goes on with all counters, and playing prints how it walks."""
    task, logs = ["--task=a1_torque_multihead", "--device=cpu"], tmp_path / "logs" / "a1_torque_multihead"
    settings = {
        "runner.num_steps_per_env": 4,
        "env.episode_length_s": 0.06,  # three steps: there are rewards of whole episodes to print
    }
    changes = [f"--set={key}={value}" for key, value in settings.items()]

    def interrupt():
        """Send the signal when the training has begun."""
        wait_for(lambda: isinstance(getattr(signal.getsignal(signal.SIGINT), "__self__", None), StopRequest))
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt, daemon=True)
    thread.start()
    changes += ["--preset=parallel", "--num_envs=2", "--timing"]
    status, output, error = run_here("train.py", *task, *changes, root=tmp_path)
    thread.join()
    notes = [line for line in output.splitlines() if line.startswith("Note: ")]
    assert any("--preset laptop" in line for line in notes)  # this one takes hours
    assert status == 130 and "Traceback" not in error
    (times,) = re.findall(r"^Time: (.*) s$", output, re.M)  # of this process, in which other tests have run
    stages = {part.rpartition(" ")[0] for part in times.split(" s, ")}
    assert {"imports and settings", "task", "first iteration", "end"} <= stages
    (first,) = logs.iterdir()
    beginning, count = checkpoint_numbers(first)
    assert beginning == 0
    checkpoint = checkpoint_file(first, count)
    state = torch.load(checkpoint, weights_only=True)
    assert 1 <= count == state["iter"] and state["infos"]["total_timesteps"] == count * 8
    events = EventAccumulator(str(first)).Reload()
    assert [event.step for event in events.Scalars("Loss/value")] == list(range(count))

    status, output, error = run_here(
        "train.py", *task, "--resume", "--verbose", f"--max_iterations={count + 2}", root=tmp_path
    )
    assert (status, error) == (0, "")
    assert "\033" not in output and " of " not in output.partition("worlds, ")[2]
    (second,) = set(logs.iterdir()) - {first}
    state = torch.load(second / f"model_{count + 2}.pt", weights_only=True)
    assert state["iter"] == count + 2 and state["infos"]["total_timesteps"] == (count + 2) * 8
    assert int(state["infos"]["task"]["total_steps"]) == (count + 2) * 8
    for number in (count, count + 1):
        assert f"Learning iteration {number}/{count + 2}" in output
    for name in ("Steps per second", "Mean reward", "Tracking/error_xy", "Health/diverged_worlds"):
        assert output.count(f"{name}:") == 2
    configs = [yaml.safe_load((run / "config.yaml").read_text()) for run in (first, second)]
    assert configs[0]["env"] == configs[1]["env"] and configs[0]["train"] == configs[1]["train"]

    noise = "--set=noise.noise_scales.dof_vel=5"
    status, output, error = run_here("play.py", *task, noise, "--num_envs=2", "--steps=10", root=tmp_path)
    assert status == 0 and "Traceback" not in error
    assert "Note: noise.noise_scales.dof_vel has no effect without noise.add_noise=true\n" in output
    assert f"model_{count + 2}.pt, after {(count + 2) * 8:,} steps of training:" in output
    for name in ("track_xy", "track_angular", "cost_of_transport", "falls_per_minute"):
        assert math.isfinite(float(re.search(rf"^\s*{name}\s+(\S+)", output, re.MULTILINE).group(1)))
    assert re.match(r"no video: .+", output.splitlines()[-1])  # see test_packaging.py for one


def test_info(tmp_path):
    """Versions, device, the folder of kernels, and renderers; nothing is written."""
    status, output, _ = run_here("info.py", root=tmp_path)
    assert status == 0 and f"  torch          {torch.__version__}\n" in output and "compiled kernels: " in output
    for title in ("versions", "machine", "GPU", "caches", "extras", "videos"):
        assert f"\n{title}\n  " in output
    assert not list(tmp_path.iterdir())


LIMIT = 600  # bytes
A1 = RESOURCES_DIR / "robots" / "a1" / "a1.xml"
COMMANDS = {
    "train.py": ([*SMALL, "--log_root={out}"], []),
    "evaluate.py": (["--task=a1_position", "--load_run={run}", "--steps=2", "--json={out}/a.json"], ["a.json"]),
    "export.py": (["--task=a1_position", "--load_run={run}", "--out={out}"], ["policy.onnx", "policy.yaml"]),
    "import_robot.py": ([str(A1), "--name=full", "--out={out}", "--force"], ["full.py", "full.xml"]),
    "report.py": (["{run}", "--out={out}"], ["report.html", "report.md", "table.csv"]),
}
"""Arguments of scripts, and the files that they would replace in the folder ``out``."""


@contextlib.contextmanager
def full_disk():
    """Context in which no file can become longer than the limit; bytecode that was cut off would break later tests."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    writes_bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        sys.dont_write_bytecode = writes_bytecode


@pytest.mark.parametrize("script", COMMANDS)
def test_a_full_disk(trained, tmp_path, script):
    """One line, exit status 2, files as they were and no unfinished ones."""
    if script == "report.py":
        pytest.importorskip("pandas", reason="the extra 'plots' is not installed")
    words, names = COMMANDS[script]
    (out := tmp_path / "out").mkdir()
    for name in names:
        (out / name).write_text("old")
    with full_disk():
        words = [word.format(out=out, run=trained["a1_position"]) for word in words]
        assert_told_in_one_line(run_here(script, *words, root=tmp_path), "File too large")
    files = {path.relative_to(out).as_posix(): path.read_text() for path in out.rglob("*") if path.is_file()}
    assert files == dict.fromkeys(names, "old")
    assert not list(tmp_path.rglob("*.part"))


def test_evaluations_on_a_full_disk(tmp_path):
    """A row that does not fit leaves no part of it."""
    row = {"steps": 10**99, "track_xy": 0.5}
    with full_disk():
        for _ in range(5):
            append_row(tmp_path / "rows.csv", row)
        assert "File too large" in error_of(append_row, tmp_path / "rows.csv", row)
    assert (tmp_path / "rows.csv").read_text() == "steps,track_xy\n" + f"{10**99},0.5\n" * 5
