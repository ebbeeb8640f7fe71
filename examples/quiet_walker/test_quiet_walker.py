"""Tests of the task, on a CPU: ``pytest``."""

import pytest
import quiet_walker  # noqa: F401 (it registers the task)
import torch

from legged_torque.envs import task_registry
from legged_torque.utils.options import Options


def make_task():
    """Two worlds on the CPU."""
    return task_registry.make_env("a1_quiet_walker", Options(device="cpu", num_envs=2))[0]


def test_reward():
    """The term is the sum of squares, and counts with its weight times the control step of 0.02 s."""
    task = make_task()
    task.dof_vel.copy_(torch.tensor([[0.0] * 12, [2.0] * 12]))
    assert task._reward_dof_vel().tolist() == [0.0, 48.0]
    weights = dict(zip(task.reward_names, task.reward_weights().tolist(), strict=True))
    assert weights["dof_vel"] == pytest.approx(-1e-4 * 0.02)


def test_steps():
    """Robots move, and everything stays finite."""
    task = make_task()
    for _ in range(5):
        obs, rewards, *_ = task.step(torch.ones(2, 12))
    assert obs["policy"].isfinite().all() and rewards.isfinite().all()
