"""A robot that stands under PD control with late commands, against a plain MuJoCo loop."""

import mujoco
import numpy as np
import torch
from support.control import CONVERGED, NOMINAL, TORQUE_LIMIT, pd_by_hand

CLOCK = {"sim.dt": 0.001, "control.decimation": 2}  # 500 Hz
LATE = {"motors.delay.range": [5, 5], "motors.delay.unit": "milliseconds"}
SETTINGS = {**CLOCK, **LATE, **CONVERGED, "terminations.contact": False}


def test_stands_as_in_mujoco(make_task):
    """Targets that sway are 5 ms late, position and speed in the same PD law are not."""
    task = make_task("a1_position", 2, **SETTINGS)
    assert task.motors.links["delay"].queue.drawn.floor().tolist() == [[5.0], [5.0]]
    model, data = task.sim.mj_model, mujoco.MjData(task.sim.mj_model)
    data.qpos[:] = [0, 0, 0.31, 1, 0, 0, 0, *NOMINAL]
    task.set_state(torch.tensor(data.qpos).expand(2, -1), torch.zeros(2, model.nv))
    sent, now = [], 0
    for step in range(250):
        action = 0.8 * np.sin(2 * np.pi * (5 * step * 0.002 + np.arange(12) / 12))
        sent += 2 * [action]
        task.step(torch.tensor(action, dtype=torch.float32).expand(2, -1))
        for _ in range(2):
            late = sent[now - 5] if now >= 5 else np.zeros(12)
            torque = pd_by_hand(late, data.qpos[7:], data.qvel[6:])
            data.ctrl[:] = np.clip(torque, -TORQUE_LIMIT, TORQUE_LIMIT)
            mujoco.mj_step(model, data)
            now += 1
        np.testing.assert_allclose(task.sim.qpos[1], data.qpos, atol=2e-3)
    assert data.qpos[2] > 0.25 and data.ncon >= 2
