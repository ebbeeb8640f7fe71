"""Torques of one kernel: as in torch, and never there where a method was overridden."""

import numpy as np
import pytest
import torch
from support.control import HIGH_UP, REAL_MOTORS, TORQUE_LIMIT, pd_by_hand, time_out
from support.settings import torques_in_torch

from legged_torque.envs.base.legged_robot import IN_TORCH, LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg

STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "contact_found", "contact_force")


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("a1_position", {"domain_rand.randomize_parameters": True}),
        ("a1_torque", {"motors.delay.range": [0, 9], "control.decimation": 3}),
        ("a1_multihead", {"motors.delay.range": [1, 2], "motors.delay.unit": "control_steps"}),
        ("a1_torque_multihead", {"motors.delay.range": [2, 6], "motors.delay.jitter": 5, "motors.delay.loss": 0.2}),
        ("a1_multihead_two_rates", {"motors.delay.range": [0, 5], "init_state.pos": [0.0, 0.0, 0.3]}),
        ("a1_torque", REAL_MOTORS | {"motors.delay.range": [0, 3], "domain_rand.randomize_parameters": True}),
    ],
)
def test_as_in_torch(make_task, name, settings):
    """The kernel does what torch does, for delayed actions too."""
    tasks = [make_task(name, 30, **settings) for _ in range(2)]
    torques_in_torch(tasks[1])
    assert not any(IN_TORCH in note for note in tasks[0].notes)
    generator = torch.Generator().manual_seed(0)
    for step in range(12):
        actions = 3.0 * torch.randn(30, tasks[0].num_actions, generator=generator)
        for task in tasks:
            task.total_steps.fill_(25_000_000)
            task.update_curriculum()
            torch.manual_seed(step)
            if step == 6:
                time_out(task, slice(0, 10))
            task.step(actions)
        for field in STATE:
            torch.testing.assert_close(getattr(tasks[0].sim, field), getattr(tasks[1].sim, field), rtol=1e-3, atol=1e-3)
            getattr(tasks[1].sim, field).copy_(getattr(tasks[0].sim, field))  # rounding errors do not add up
    assert tasks[0].contacts.any()


class Doubled(LeggedRobot):
    """Overrides the torques in torch only."""

    def _compute_torques(self, actions):
        return 2.0 * super()._compute_torques(actions)


def test_overrides_count():
    """A class that overrides the method gets its own torques, and a note says what that costs."""
    cfg = A1Cfg()
    cfg.env.num_envs, cfg.control.decimation, cfg.init_state.pos = 2, 1, HIGH_UP["init_state.pos"]
    task = Doubled(cfg)
    q, qd = task.dof_pos.numpy().copy(), task.dof_vel.numpy().copy()
    task.step(torch.full((2, 12), 0.3))
    expected = np.clip(2.0 * pd_by_hand(0.3, q, qd), -TORQUE_LIMIT, TORQUE_LIMIT)
    np.testing.assert_allclose(task.torques, expected, atol=1e-4)
    assert any(IN_TORCH in note for note in task.notes)


def test_override_of_one_task_counts(make_task):
    """So does a function that replaces the method of a task after steps, and what it replaced when it is put back."""
    task = make_task("a1_torque_multihead", 2, **HIGH_UP, **{"control.decimation": 1})
    actions = torch.ones(2, 24)
    task.step(actions)
    task._compute_torques = lambda actions: torch.full((2, 12), 7.0)
    task.step(actions)
    assert (task.torques == 7.0).all()
    del task._compute_torques
    task.step(actions)
    assert not (task.torques == 7.0).any()
