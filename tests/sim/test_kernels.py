"""The kernels of random events against formulas by hand."""

import math

import mujoco
import numpy as np
import torch


def rotation_matrices(roll, pitch, yaw):
    """Rotations about the world's x, then y, then z axis."""
    result = []
    for r, p, y in zip(roll, pitch, yaw, strict=True):
        about_x = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
        about_y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
        about_z = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
        result.append(about_z @ about_y @ about_x)
    return np.array(result)


def test_orientation(make_task):
    """Roll, pitch and yaw are rotations about the world's axes in this order, in the worlds of the mask."""
    ranges = {f"domain_rand.init_{name}": [-math.pi, math.pi] for name in ("roll", "pitch", "yaw")}
    task = make_task("a1_torque", 50, **ranges)
    mask = torch.arange(50) % 2 == 0
    drawn = task.events.init_angles
    before, angles = task.sim.qpos.clone(), drawn.clone()
    task.events.apply(mask)
    assert torch.equal(task.sim.qpos[~mask], before[~mask]) and torch.equal(
        task.events.init_angles[~mask], angles[~mask]
    )
    assert not torch.isclose(drawn[mask], angles[mask]).all(dim=1).any()
    angles = drawn[mask].double().numpy()
    for quat, expected in zip(task.sim.qpos[mask, 3:7].double(), rotation_matrices(*angles.T), strict=True):
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, quat.numpy())
        np.testing.assert_allclose(matrix.reshape(3, 3), expected, atol=1e-6)
