"""A training on a CPU uses all cores: train.py starts a process for each further one."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

ROOT = Path(__file__).resolve().parents[2]
STEPS, WORLDS = 4, 2
SMALL = [f"--num_envs={WORLDS}", f"--set=runner.num_steps_per_env={STEPS}", "--set=algorithm.num_mini_batches=2"]
SMALL += ["--device=cpu", "--logger=none", "--set=evaluation.interval=0", "--task=a1_position"]


def train(folder, *words):
    """Start train.py on two cores."""
    command = [sys.executable, ROOT / "scripts" / "train.py", *SMALL, f"--log_root={folder}", *words]
    environment = os.environ | {"OMP_NUM_THREADS": "2", "PYTHONUNBUFFERED": "1"}
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def children(process):
    """Numbers of the processes that a process has started and that are not over."""
    return Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()


@pytest.mark.skipif(sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2, reason="two cores of Linux")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_all_cores(tmp_path, end):
    """Both processes train one policy, and both end when the first one is interrupted, which saves, or killed."""
    with train(tmp_path, "--max_iterations=100000") as process:
        output, started = "", []
        for line in process.stdout:  # until both have closed it
            output += line
            if line.startswith("iteration ") and not started:
                started = children(process)
                process.send_signal(end)
    assert len(started) == 1 and "Traceback" not in output, output
    (run,) = (tmp_path / "a1_position").iterdir()
    assert yaml.safe_load((run / "config.yaml").read_text())["processes"] == 2
    if end == signal.SIGINT:
        assert process.returncode == 130 and output.count("Stopping after this iteration") == 1
        last = max(run.glob("model_*.pt"), key=lambda file: int(file.stem.split("_")[1]))
        state = torch.load(last, weights_only=True)
        assert state["infos"]["total_timesteps"] == state["iter"] * 2 * WORLDS * STEPS > 0
