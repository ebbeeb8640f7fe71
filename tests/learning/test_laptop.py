"""The preset laptop: a training on a CPU, in a process per core, with shorter curricula."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from support.clock import Clock
from support.scripts import COMMAND, PATHS

from legged_torque.envs import task_registry
from legged_torque.envs.base.curriculum import LinearCurriculum
from legged_torque.learning.training_display import TrainingDisplay
from legged_torque.utils.options import Options

ROOT = Path(__file__).resolve().parents[2]
STEPS, WORLDS = 4, 2
SMALL = [f"--num_envs={WORLDS}", f"--set=runner.num_steps_per_env={STEPS}", "--set=algorithm.num_mini_batches=2"]
SMALL += ["--device=cpu", "--logger=none", "--set=evaluation.interval=0", "--task=a1_position"]


def train_and_end(folder, number, *words):
    """Send train.py on two cores a signal after an iteration; return status, output, number of others."""
    command = [*COMMAND, ROOT / "scripts" / "train.py", *SMALL, f"--log_root={folder}", *words]
    environment = os.environ | PATHS | {"OMP_NUM_THREADS": "2"}
    output, others = "", []
    with subprocess.Popen(
        command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        for line in process.stdout:  # until all have closed it
            output += line
            if line.startswith("iteration ") and not others:
                others = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
                process.send_signal(number)
    assert "Traceback" not in output, output
    return process.returncode, output, len(others)


@pytest.mark.skipif(sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2, reason="two cores of Linux")
def test_all_cores(tmp_path):
    """Two processes train one policy: both end when the first one is interrupted, resume, and end when it is killed."""
    status, output, others = train_and_end(tmp_path, signal.SIGINT, "--max_iterations=100000")
    assert (status, others) == (130, 1) and output.count("Stopping after this iteration") == 1
    (run,) = (tmp_path / "a1_position").iterdir()
    assert yaml.safe_load((run / "config.yaml").read_text())["processes"] == 2
    last = max(run.glob("model_*.pt"), key=lambda file: int(file.stem.split("_")[1]))
    state = torch.load(last, weights_only=True)
    assert state["infos"]["total_timesteps"] == state["iter"] * 2 * WORLDS * STEPS > 0
    status, output, others = train_and_end(tmp_path, signal.SIGKILL, "--resume")
    assert (status, others) == (-signal.SIGKILL, 1) and "start anew" not in output
    first = re.search(r"^iteration (\d+) of \d+, .*?; steps ([\d,]+)", output, flags=re.MULTILINE)
    assert int(first[1]) == state["iter"] + 1 and int(first[2].replace(",", "")) == int(first[1]) * 2 * WORLDS * STEPS


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


def test_when_it_walks(capsys):
    """The time until it walks is that of the steps which are left at this speed, as long as it does not walk."""
    clock, shown = Clock(), ["walks in about 3 min", "walks later than others did", "tracking 0.750"]
    measured = {"Evaluation/falls_per_minute": 0.0}
    with TrainingDisplay("title", "folder", 1000, 0, 1000, clock=clock, walks_after=250_000) as display:
        for i in range(1, 301):
            clock.sleep(1.0)  # 1000 steps per second
            tracking = {"Evaluation/track_percentage": 0.75, **measured} if i == 300 else {}
            display.add_iteration(i, 1000 * i, tracking)
    lines = capsys.readouterr().out.splitlines()
    for line, text in zip((lines[6], lines[26], lines[-1]), shown, strict=True):  # after 61, 261 and 300 s
        assert text in line
    assert "walks" not in lines[-1]
