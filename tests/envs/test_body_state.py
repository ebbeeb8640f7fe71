"""Positions, velocities and forces of feet and bodies are MuJoCo's own, on every engine."""

import copy

import mujoco
import numpy as np
import pytest
import torch
from support.fused import compiled, draw_states, make_crab, put
from support.robot_files import read_robot
from support.settings import error_of

from legged_torque.envs.base.state import RobotState
from legged_torque.sim.registry import make_engine


def make_jointed():
    """An arm with slides, several joints on a body, and reference angles; a body without joints is kept."""
    return read_robot("jointed")


ROBOTS = {"crab": (make_crab, "fused"), "jointed": (make_jointed, "mujoco_warp")}
FEET = {"crab": (["foot", "thigh", "tyre"], [0, 1, 2]), "jointed": (["upper", "palm", "thumb"], [0, 1, 1])}
"""Geoms that stand for feet, and the foot of each."""
LONGER = (0.1, 0.2, 0.3)
"""How much farther the last body is from its parent in world 3 [m]."""


@pytest.fixture(params=ROBOTS)
def moving(request):
    """A simulator after a step, the state of its robots, and for each world MuJoCo's data before and after it."""
    make, engine = ROBOTS[request.param]
    model = compiled(make())
    geoms, foot_of = FEET[request.param]
    states, sim = draw_states(model, 5, (0.1, 0.2)), make_engine(engine, model, 5, "cpu", 100, 50)
    places = [[model.geom(ref).name for ref in model.sensor_refid].index(name) for name in geoms]
    state = RobotState(sim, None, places, foot_of, 1, 0.02)
    longer = np.zeros((5, 3))
    if engine == "fused":  # parameters per world need one hinge per body
        longer[3] = LONGER
        sim.field("body_pos")[:, -1] += torch.tensor(longer)
        sim.applied_forces()  # whose kernel test_fused.py needs as well
    put(sim, states)
    sim.step()
    after = {"qpos": sim.qpos.numpy(), "qvel": sim.qvel.numpy()}
    references = []
    for world in range(5):
        own = copy.deepcopy(model)
        own.body_pos[-1] += longer[world]
        both = ({name: values[world] for name, values in parts.items()} for parts in (states, after))
        references.append([in_mujoco(own, part) for part in both])
    return sim, state, references, geoms, foot_of


def in_mujoco(model, state):
    """MuJoCo's data of a state."""
    data = mujoco.MjData(model)
    for name, values in state.items():
        getattr(data, name)[:] = values
    mujoco.mj_forward(model, data)
    return data


def velocity(model, data, kind, number):
    """The velocity of a frame's origin in the world by ``mj_objectVelocity``."""
    result = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, kind, number, result, 0)
    return result[3:]


def force(model, data, geom):
    """The sum of the forces on a geom in the world by ``mj_contactForce``."""
    total, local = np.zeros(3), np.zeros(6)
    for i, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, i, local)
        total += contact.frame.reshape(3, 3).T @ local[:3] * (1.0 * (contact.geom2 == geom) - (contact.geom1 == geom))
    return total


def test_bodies(moving):
    """Every body by its name, with joints off its origin, also where a world's geometry is its own."""
    sim, state, references, *_ = moving
    model = sim.mj_model
    names = [model.body(body).name for body in range(1, model.nbody) if model.body(body).name]
    assert names
    for world, (_, data) in enumerate(references):
        for name in names:
            expected = velocity(data.model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(name).id)
            np.testing.assert_allclose(state.body_pos(name)[world], data.body(name).xpos, atol=2e-6)
            np.testing.assert_allclose(state.body_vel(name)[world], expected, atol=3e-5)
    line = error_of(state.body_pos, names[0] + "k")
    assert names[0] in line and "did you mean" in line


def test_feet(moving):
    """One position, velocity and force per foot, which may have several geoms; the force is of before the step."""
    sim, state, references, geoms, foot_of = moving
    model, touched = sim.mj_model, 0
    for world, (before, data) in enumerate(references):
        for foot in range(max(foot_of) + 1):
            own = [model.geom(name).id for name, of in zip(geoms, foot_of, strict=True) if of == foot]
            speeds = [velocity(data.model, data, mujoco.mjtObj.mjOBJ_GEOM, geom) for geom in own]
            forces = sum(force(data.model, before, geom) for geom in own)
            np.testing.assert_allclose(state.foot_pos[world, foot], data.geom_xpos[own].mean(axis=0), atol=2e-6)
            np.testing.assert_allclose(state.foot_vel[world, foot], np.mean(speeds, axis=0), atol=3e-5)
            np.testing.assert_allclose(state.foot_contact_force[world, foot], forces, rtol=3e-3, atol=0.3)
            touched += np.abs(forces).max() > 1.0
    assert touched > 1
