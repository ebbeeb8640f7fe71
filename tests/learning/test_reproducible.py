"""Trainings repeat to the bit on a CPU, and survive kills."""

import random
import time

from support.reproducible import content, differences, start
from support.scripts import run_here

from legged_torque.utils.files import is_whole_archive
from legged_torque.utils.runs import CONFIG_FILE

SMALL = ["--task=a1_torque", "--device=cpu", "--num_envs=3", "--perturbation=low", "--set=runner.num_steps_per_env=4"]
SMALL += ["--set=algorithm.num_mini_batches=1", "--set=actor.hidden_dims=[8]", "--set=critic.hidden_dims=[8]"]
SMALL += ["--set=algorithm.annealing_start=1"]  # trainings of other lengths are compared
SMALL += ["--set=evaluation.interval=1", "--set=evaluation.num_samples=6", "--set=runner.save_interval=2"]


def train(folder, *words):
    """Train in this process; return what that leaves."""
    status, _, error = run_here("train.py", *SMALL, *words, f"--log_root={folder}", "--logger=none", root=folder)
    assert (status, error) == (0, "")
    return content(folder)


def test_killed(tmp_path):
    """All files are whole after a kill, and the training goes on from the last checkpoint to the same end."""
    logs, straight = tmp_path / "logs", tmp_path / "straight"
    process = start(logs, *SMALL, "--max_iterations=1000000")
    while len(list(logs.glob("*/*/model_*.pt"))) < 3:
        assert process.poll() is None
        time.sleep(0.01)
    time.sleep(random.Random(2).uniform(0.0, 0.3))
    process.kill()
    process.communicate()
    assert all(map(is_whole_archive, logs.glob("*/*/*_*.pt")))
    assert all((run / CONFIG_FILE).is_file() for run in logs.glob("*/*/"))
    last = max(int(file.stem[6:]) for file in logs.glob("*/*/model_*.pt"))
    resumed = train(logs, "--resume", f"--max_iterations={last + 1}")
    straight.mkdir()
    other = train(straight, f"--max_iterations={last + 1}")
    assert not [name for name in differences(resumed, other) if name.startswith("checkpoint.")]
