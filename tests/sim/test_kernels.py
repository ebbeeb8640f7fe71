"""The kernels of random events against formulas by hand."""

import math

import mujoco
import numpy as np
import torch


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
    for found, (roll, pitch, yaw) in zip(task.sim.qpos[mask, 3:7], angles, strict=True):
        quat = np.zeros(4)
        mujoco.mju_euler2Quat(quat, [roll, pitch, yaw], "XYZ")  # capitals: about the world's axes
        np.testing.assert_allclose(np.sign(found[0] * quat[0]) * found, quat, atol=1e-6)
