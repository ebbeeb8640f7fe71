"""Forces that a user applies to bodies and joints, in both engines, against plain MuJoCo."""

import mujoco
import numpy as np
import pytest
import torch
from support.fused import AIR, FIELDS, FLOOR, ROBOTS, compiled, draw_states, put, random

from legged_torque.sim.registry import ENGINES, make_engine


def step_mujoco(model, states, xfrc, qfrc):
    """Velocities after one step of plain MuJoCo."""
    data, result = mujoco.MjData(model), []
    for world in range(len(xfrc)):
        for field in FIELDS:
            getattr(data, field)[:] = states[field][world]
        data.xfrc_applied[:], data.qfrc_applied[:] = xfrc[world], qfrc[world]
        mujoco.mj_step(model, data)
        result.append(data.qvel.copy())
    return np.array(result)


@pytest.mark.parametrize(
    ("engine", "robot", "heights"),
    [("fused", "crab", AIR), ("fused", "crab", FLOOR), ("mujoco_warp", "a1", AIR)],
)
def test_applied_forces(engine, robot, heights):
    """Wrenches on all bodies and forces on all degrees of freedom act as in MuJoCo, and each of them acts."""
    model = compiled(ROBOTS[robot]())
    states = draw_states(model, 20, heights)
    xfrc, qfrc = random((20, model.nbody, 6), -5.0, 5.0, 1), random((20, model.nv), -3.0, 3.0, 2)
    sim = make_engine(engine, model, 20, "cpu", 100, 50)
    for of_bodies, of_joints in ((xfrc, qfrc), (xfrc, 0.0 * qfrc), (0.0 * xfrc, qfrc)):
        put(sim, states)
        for applied, values in zip(sim.applied_forces(), (of_bodies, of_joints), strict=True):
            applied.copy_(torch.tensor(values))
        sim.step()
        expected = step_mujoco(model, states, of_bodies, of_joints)
        error = np.abs(sim.qvel.double().numpy() - expected).max(axis=1)
        assert np.median(error) < 1e-4 and error.max() < 5e-3
        without = step_mujoco(model, states, 0.0 * xfrc, 0.0 * qfrc)
        assert (np.abs(expected - without).max(axis=1) > 0.05).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_reset_clears_applied_forces(engine):
    """A reset clears the forces of its worlds and no other's; who did not ask for them has none."""
    model = compiled(ROBOTS["a1"]())
    sim = make_engine(engine, model, 2, "cpu")
    for forces in sim.applied_forces():
        forces.fill_(1.0)
    sim.reset(torch.tensor([False, True]))
    for forces in sim.applied_forces():
        assert (forces[0] == 1.0).all() and (forces[1] == 0.0).all()
