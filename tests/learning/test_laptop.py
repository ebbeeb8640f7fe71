"""The preset laptop: a training on a CPU, in a process per core, with shorter curricula."""

import os
import re
import runpy
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from support.clock import Clock
from support.scripts import COMMAND, PATHS, ROOT, assert_told_in_one_line, run_here
from support.settings import build_runner

from legged_torque.envs import task_registry
from legged_torque.envs.base.curriculum import LinearCurriculum
from legged_torque.learning.training_display import TrainingDisplay
from legged_torque.utils.options import Options

STEPS, WORLDS = 4, 2
SMALL = [f"--num_envs={WORLDS}", f"--set=runner.num_steps_per_env={STEPS}", "--set=algorithm.num_mini_batches=2"]
SMALL += ["--device=cpu", "--logger=none", "--set=evaluation.interval=0", "--task=a1_position"]


TWO_CORES = pytest.mark.skipif(sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2, reason="two cores of Linux")


def end_first_of_two(number, line, *command):
    """Send the first of two processes a signal after a line that begins so; return its status, and all output."""
    how = {"env": os.environ | PATHS | {"OMP_NUM_THREADS": "2"}, "text": True, "stderr": subprocess.STDOUT}
    output, others = "", []
    with subprocess.Popen([*COMMAND, *command], stdout=subprocess.PIPE, **how) as process:
        for text in process.stdout:  # until all have closed it
            output += text
            if text.startswith(line) and not others:
                others = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
                process.send_signal(number)
    assert len(others) == 1 and "Traceback" not in output and "leak" not in output, output
    return process.returncode, output


@TWO_CORES
def test_all_cores(tmp_path):
    """A resumed run has its two processes again, which train one policy; both end when the first one is interrupted."""
    words = [*SMALL, f"--log_root={tmp_path}"]
    assert run_here("train.py", *words, "--max_iterations=1", root=tmp_path)[0] == 0
    (config,) = tmp_path.glob("a1_position/*/config.yaml")
    config.write_text(config.read_text().replace("processes: 1\n", "processes: 2\n"))
    command = [ROOT / "scripts" / "train.py", *words, "--max_iterations=100000", "--resume"]
    status, output = end_first_of_two(signal.SIGINT, "iteration ", *command)
    assert status == 130 and output.count("Stopping after this iteration") == 1
    (run,) = set((tmp_path / "a1_position").iterdir()) - {config.parent}
    assert yaml.safe_load((run / "config.yaml").read_text())["processes"] == 2
    last = max(run.glob("model_*.pt"), key=lambda file: int(file.stem.split("_")[1]))
    state, first = torch.load(last, weights_only=True), WORLDS * STEPS
    assert state["infos"]["total_timesteps"] == first + (state["iter"] - 1) * 2 * WORLDS * STEPS > first
    assert re.search(rf"^iteration 2 of 100000, .*?; steps {first + 2 * WORLDS * STEPS}", output, flags=re.MULTILINE)


@TWO_CORES
def test_the_others_end_with_the_first(tmp_path):
    """One process per usable core is started; once they run, they end when the first one is killed."""
    (tmp_path / "both.py").write_text(
        "import time\nfrom legged_torque.utils import distributed as d\n"
        "if not d.use_cores(d.usable_cores()):\n    print('started', flush=True)\ntime.sleep(60)\n"
    )
    assert end_first_of_two(signal.SIGKILL, "started", tmp_path / "both.py")[0] == -signal.SIGKILL


def test_one_ends_before_all_have_joined(tmp_path):
    """The first process does not wait for it."""
    text = "from legged_torque.utils import cli, distributed\n"
    text += "cli.run_script(lambda: distributed.use_cores(2) and distributed.join('cpu'))\n"
    (tmp_path / "both.py").write_text(text)
    how = {"env": os.environ | PATHS, "text": True, "capture_output": True, "timeout": 60}
    done = subprocess.run([*COMMAND, tmp_path / "both.py"], **how)
    result = done.returncode, done.stdout, done.stderr
    assert_told_in_one_line(result, "another process has ended before the training began")


SHORTER = " --preset laptop takes minutes, and"
LONG = [("a1_position", "parallel", SHORTER), ("a1_position", "flashsac", SHORTER), ("a1_torque_gravity", None, "")]


@pytest.mark.parametrize(("task", "preset", "shorter"), LONG)
def test_long_trainings(task, preset, shorter):
    """A note says that a training takes hours on a CPU, and names the preset laptop where a task has it."""
    note = runpy.run_path(str(ROOT / "scripts" / "train.py"))["length_note"]
    said = note(task_registry.get_cfgs(task, Options(task=task, preset=preset))[1])
    assert said == f"this training takes hours on a CPU;{shorter} Ctrl-C keeps the run"
    assert not note(task_registry.get_cfgs("a1_position", Options(task="a1_position", preset="laptop"))[1])


@pytest.mark.parametrize("steps", [0, 700_000, 2_000_000, 20_000_000])
def test_curricula_are_shorter(steps):
    """After three tenths of the steps, each value that changes linearly is what it is in a training on a GPU."""
    values = {}
    for preset, share in {"parallel": 1.0, "laptop": 0.3}.items():
        env_cfg, _ = task_registry.get_cfgs("a1_torque_curriculum_multihead", Options(device="cpu", preset=preset))
        rewards, mixing = env_cfg.rewards.curriculum, env_cfg.control.mixing
        changes = [rewards.tracking_lin_vel, rewards.tracking_ang_vel, rewards.nominal_position, mixing.torque]
        values[preset] = LinearCurriculum(changes, "cpu")(torch.tensor(steps * share))
    torch.testing.assert_close(values["laptop"], values["parallel"])


def test_the_bias_decays_sooner():
    """Decaying action priors need three tenths of the steps, too."""
    decay = {}
    for preset in ("parallel", "laptop"):
        decay[preset] = task_registry.get_cfgs("a1_decap", Options(device="cpu", preset=preset))[0].control.decap
    assert decay["laptop"].k == pytest.approx(0.3 * decay["parallel"].k) and decay["parallel"].k == 409_600.0


@pytest.mark.parametrize("preset", ["parallel", "laptop"])
def test_the_pd_part_fades_in_time(preset):
    """A policy has to learn to walk without it while annealing has not made its steps small."""
    env_cfg, train_cfg = task_registry.get_cfgs("a1_torque_multihead", Options(device="cpu", preset=preset))
    steps, fading = train_cfg.runner.total_steps, env_cfg.control.mixing.pd
    assert fading.t_start < fading.t_end <= train_cfg.algorithm.annealing_start * steps


def test_evaluations_take_as_long_at_200_hz():
    """World steps of an evaluation are four times as many as at 50 Hz."""
    options = Options(device="cpu", preset="laptop")
    slow, fast = (task_registry.get_cfgs(f"a1_{name}", options)[1] for name in ("position", "multihead_two_rates"))
    assert fast.evaluation.num_samples == 4 * slow.evaluation.num_samples


def test_when_it_walks(capsys):
    """The time until it walks is that of the steps which are left at this speed, as long as it does not walk.

    A training that was resumed after these steps is not late before an evaluation says so.
    """
    clock, shown = Clock(), ["an A1 walks in about 3 min", "walks later than an A1 did", "tracking 0.750"]
    measured = {"Evaluation/falls_per_minute": 0.0}
    with TrainingDisplay("title", "folder", 1000, 0, 1000, clock=clock, walks_after=250_000) as display:
        for i in range(1, 301):
            clock.sleep(1.0)  # 1000 steps per second
            tracking = {200: {"Evaluation/track_percentage": 0.5}, 300: {"Evaluation/track_percentage": 0.75}}
            display.add_iteration(i, 1000 * i, {**tracking[i], **measured} if i in tracking else {})
    lines = capsys.readouterr().out.splitlines()
    for line, text in zip((lines[6], lines[26], lines[-1]), shown, strict=True):  # after 61, 261 and 300 s
        assert text in line
    assert "walks" not in lines[-1]
    with TrainingDisplay("title", "folder", 1000, 0, 1000, clock=clock, walks_after=250_000) as display:
        for i in range(30):
            clock.sleep(1.0)
            display.add_iteration(i + 1, 1000 * i + 300_000, {})
    assert "steps/s" in (output := capsys.readouterr().out) and "walks" not in output


WHERE = [("a1_torque_multihead", 256, True), ("a1_torque_multihead", 64, False)]
WHERE += [("a1_rough_torque_multihead", 256, False), ("a1_multihead_two_rates", 256, False)]


@pytest.mark.parametrize(("task", "worlds", "is_known"), WHERE)
def test_where_it_is_known_when_it_walks(make_task, tmp_path, capsys, task, worlds, is_known):
    """It was measured on a plane, in 256 worlds and at 50 Hz; a training elsewhere does not tell."""
    build_runner(make_task, task, worlds, log_root=tmp_path, **{"runner.walks_after": 4_000_000}).learn(2)
    last = capsys.readouterr().out.splitlines()[-1]
    assert "steps/s" in last and ("an A1 walks in" in last) == is_known
