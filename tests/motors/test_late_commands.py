"""A robot that stands under PD torques that are late, against a plain MuJoCo loop."""

import mujoco
import numpy as np
import pytest
import torch
from support.control import CONVERGED, NOMINAL, TORQUE_LIMIT

LATENCIES = [0, 2, 5, 10]  # [ms]
KP, KD = 60.0, 0.3
"""Gains of a policy that computes PD torques itself: after 5 ms, nothing is left of their damping, Kd - Kp T."""


def calves_in_mujoco(model, latency, damping, steps):
    """Speeds of the calves of a standing A1 that gets PD torques late. Shape: (steps, 4)."""
    data, sent, speeds = mujoco.MjData(model), [np.zeros(12)] * latency, []
    data.qpos[:] = [0, 0, 0.31, 1, 0, 0, 0, *NOMINAL]
    for _ in range(steps):
        sent.append(KP * (NOMINAL - data.qpos[7:]) - KD * data.qvel[6:])
        data.ctrl[:] = np.clip(sent[-1 - latency] - damping * data.qvel[6:], -TORQUE_LIMIT, TORQUE_LIMIT)
        mujoco.mj_step(model, data)
        speeds.append(data.qvel[8::3].copy())
    return np.array(speeds)


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_shaking_and_its_cure(make_task, damping):
    """A PD law sent as torques shakes calves from a latency of Kd / Kp on; damping on the drive, not late, ends it."""
    settings = {"sim.dt": 0.001, "control.decimation": 1, "motors.drive.damping": damping, **CONVERGED}
    late = {"motors.delay.range": [0, 10], "motors.delay.unit": "milliseconds", "terminations.contact": False}
    chain = {"motors.chain": ["delay", "drive", "ideal"]}
    task = make_task("a1_torque", len(LATENCIES), **settings, **late, **chain)
    task.motors.links["delay"].queue.drawn.copy_(torch.tensor(LATENCIES).unsqueeze(1))
    start = torch.tensor([0, 0, 0.31, 1, 0, 0, 0, *NOMINAL])
    task.set_state(start.expand(len(LATENCIES), -1), torch.zeros(len(LATENCIES), 18))
    apart = np.stack([calves_in_mujoco(task.sim.mj_model, latency, damping, 1000) for latency in LATENCIES], axis=1)
    speeds = np.zeros_like(apart)
    for step in range(1000):
        task.step((KP * (task.default_dof_pos - task.dof_pos) - KD * task.dof_vel) / task.cfg.control.torque_scale)
        speeds[step] = task.dof_vel[:, 2::3]
    np.testing.assert_allclose(speeds[:200], apart[:200], atol=0.01)
    shakes = KP * np.array(LATENCIES) / 1000.0 >= KD + damping
    assert shakes.any() == (damping == 0.0)
    for calves in (speeds, apart):
        highest = np.abs(calves[900:]).max(axis=(0, 2))  # [rad/s]
        assert (highest[shakes] > 2.0).all() and (highest[~shakes] < 0.1).all()
