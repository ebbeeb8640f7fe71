"""Torques inside the physics kernel: as in torch, as by hand, and never those of a method that was overridden."""

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from support.control import REAL_MOTORS, TORQUE_LIMIT, pd_by_hand
from support.episodes import HIGH_UP, time_out
from support.fused import compiled, make_walker, random
from support.settings import torques_in_torch

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.sim.registry import make_engine

STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "contact_found", "contact_force")


def launches(task):
    """A list that gets the name of each call that moves the worlds."""
    notes = []

    def noted(name, function):
        def call(*args, **kwargs):
            notes.append(name)
            function(*args, **kwargs)

        return call

    for name in ("step", "drive"):
        setattr(task.sim, name, noted(name, getattr(task.sim, name)))
    return notes


# ------------------------------------------------------------------------------------------------ the simulator


@wp.struct
class Springs:
    """What the next function reads."""

    target: wp.array2d[float]  # of each motor [rad]
    stiffness: wp.array[float]  # at each physics step [N m/rad]


@wp.func
def spring(springs: Springs, world: int, motor: int, step: int, pos: float, vel: float) -> float:
    """Return the torque of springs whose stiffness changes from step to step."""
    return springs.stiffness[step] * (springs.target[world, motor] - pos) - 0.1 * vel


def test_simulator_drives():
    """A law of the position, the speed and the step acts as by hand in MuJoCo; motors are not in the joints' order.

    In the last world the law gives a motor no number, with which MuJoCo stops all motors; only this world is flagged.
    """
    model = compiled(make_walker())
    sim = make_engine("fused", model, 6, "cpu", 100, 50)
    stiffness, target = np.array([2.0, 0.0, 7.0, 3.0, 5.0], np.float32), random((6, model.nu), -0.5, 0.5)
    target[5, 2] = np.nan
    sim.qpos[:, 2] = torch.linspace(0.15, 0.4, 6)
    sim.qvel.copy_(torch.tensor(random((6, model.nv), -2.0, 2.0)))
    joints = model.actuator_trnid[:, 0]
    references = []
    for world in range(6):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = sim.qpos[world], sim.qvel[world]
        for step in range(5):
            pos, vel = data.qpos[model.jnt_qposadr[joints]], data.qvel[model.jnt_dofadr[joints]]
            data.ctrl[:] = stiffness[step] * (target[world] - pos) - 0.1 * vel
            mujoco.mj_step(model, data)
        references.append(data)
    springs = Springs()
    springs.target, springs.stiffness = wp.array(target, dtype=float), wp.array(stiffness, dtype=float)
    sim.drive(5, spring, springs)
    assert sim.contact_found.any() and np.abs(references[0].ctrl).max() > 0.5
    for world, data in enumerate(references):
        np.testing.assert_allclose(sim.qvel[world], data.qvel, rtol=0, atol=2e-3)
        np.testing.assert_allclose(sim.ctrl[world], data.ctrl, rtol=0, atol=2e-3)
        assert sim.contact_found[world].sum() == data.ncon
    sim.flag_diverged()
    assert sim.diverged.tolist() == [False] * 5 + [True]


# ------------------------------------------------------------------------------------------------ tasks


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
    """One launch per control step does what one per physics step does with torques from torch, delayed ones too."""
    tasks = [make_task(name, 30, **settings) for _ in range(2)]
    torques_in_torch(tasks[1])
    notes = [launches(task) for task in tasks]
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
    assert notes == [["drive"] * 12, ["step"] * 12 * tasks[0].cfg.control.decimation]


class Doubled(LeggedRobot):
    """Overrides the torques in torch only."""

    def _compute_torques(self, actions):
        return 2.0 * super()._compute_torques(actions)


def test_overrides_count():
    """A class that overrides the method gets its own torques, and a note says that they leave the kernel."""
    cfg = A1Cfg()
    cfg.env.num_envs, cfg.control.decimation, cfg.init_state.pos = 2, 1, HIGH_UP["init_state.pos"]
    task = Doubled(cfg)
    notes, q, qd = launches(task), task.dof_pos.numpy().copy(), task.dof_vel.numpy().copy()
    task.step(torch.full((2, 12), 0.3))
    assert notes == ["step"]
    expected = np.clip(2.0 * pd_by_hand(0.3, q, qd), -TORQUE_LIMIT, TORQUE_LIMIT)
    np.testing.assert_allclose(task.torques, expected, atol=1e-4)
    assert any("outside of the physics kernel" in note for note in task.notes)


def test_override_of_one_task_counts(make_task):
    """So does a function that replaces the method of a task after steps, and what it replaced when it is put back."""
    task = make_task("a1_torque_multihead", 2, **HIGH_UP, **{"control.decimation": 1})
    notes, actions = launches(task), torch.ones(2, 24)
    task.step(actions)
    task._compute_torques = lambda actions: torch.full((2, 12), 7.0)
    task.step(actions)
    assert (task.torques == 7.0).all()
    del task._compute_torques
    task.step(actions)
    assert notes == ["drive", "step", "drive"] and not (task.torques == 7.0).any()
