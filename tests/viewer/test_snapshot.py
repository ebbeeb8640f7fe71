"""The values that viewers show: parts of torques, contact forces and PD targets, against hand computations."""

import numpy as np
import pytest
import torch

from legged_torque.envs import task_registry
from legged_torque.viewer.snapshot import watched

NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")


def make_watched(make_task, name, **settings):
    """A watched task of two worlds."""
    task = make_task(name, num_envs=2, **settings)
    torch.manual_seed(1)
    return watched(type(task))(task.cfg, "cpu")


@pytest.mark.parametrize(("name", "parts"), [("a1_position", 0), ("a1_torque", 0), ("a1_torque_multihead", 2)])
def test_torque_parts(make_task, name, parts):
    """The parts of weighted action terms sum to the torque. Without weights there are none, without PD no targets."""
    task = make_watched(make_task, name)
    task.motors.strength.fill_(0.9)
    for _ in range(3):
        task.step(torch.randn(2, task.num_actions))
    snapshot = task.snapshot(0.0, 0)
    assert snapshot.torque_parts.shape == (parts, 12)
    assert snapshot.targets.shape == (0 if name == "a1_torque" else 12,)
    if parts:
        low, high = task.torque_limits.numpy()
        pd, direct = snapshot.torque_parts
        np.testing.assert_allclose(np.clip(pd + direct, low, high), snapshot.torques, rtol=1e-5, atol=1e-5)
        assert np.any(pd) and np.any(direct)
        expected = 0.9 * task.mixing[1] * task.torque_scale[0] * task.actions[0, 12:]
        np.testing.assert_allclose(direct, expected.numpy(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=NEEDS_GPU)])
def test_watching_changes_nothing(device):
    """A watched task does what the task does (bits on a CPU), and its parts are right in a CUDA graph too."""
    task_class = task_registry.get_task_class("a1_torque_multihead")
    env_cfg, _ = task_registry.get_cfgs("a1_torque_multihead")
    env_cfg.env.num_envs = 2
    results = []
    for made_of in (task_class, watched(task_class)):
        torch.manual_seed(2)
        task = made_of(env_cfg, device)
        for step in range(5):
            obs = task.step(torch.sin(step + torch.arange(48.0, device=device)).view(2, 24))[0]
        results.append(obs["critic"])
    tolerance = 0.0 if device == "cpu" else 1e-3
    torch.testing.assert_close(*results, rtol=tolerance, atol=tolerance)
    total = task.torque_parts.sum(dim=0).clamp(*task.torque_limits)
    torch.testing.assert_close(total, task.torques, rtol=1e-5, atol=1e-4)


def test_targets_of_pd_control(make_task):
    """The torque of the last physics step is that of a spring to the shown target and a damper."""
    task = make_watched(make_task, "a1_position", **{"control.decimation": 1})
    for step in range(5):
        position, velocity = task.dof_pos[1].clone(), task.dof_vel[1].clone()
        task.step(torch.full((2, 12), 0.05 * step))
    snapshot = task.snapshot(0.0, 1)
    torque = task.p_gains[1] * (torch.from_numpy(snapshot.targets) - position) - task.d_gains[1] * velocity
    expected = (torque * task.motor_strength[1]).clamp(*task.torque_limits)
    np.testing.assert_allclose(snapshot.torques, expected.numpy(), atol=1e-3)
    touching = np.linalg.norm(snapshot.forces[task.feet_indices.numpy()], axis=1) > 0.0
    assert snapshot.feet.tolist() == touching.tolist() and snapshot.age == 5
