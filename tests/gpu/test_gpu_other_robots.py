"""The fused step with two and eight threads per world, and of robots whose parts touch, against plain MuJoCo."""

import mujoco
import numpy as np
import pytest
from support.fused import AIR, FIELDS, FLOOR, assert_applied_forces_act, compiled, draw_states, make_crab, step_mujoco
from support.on_device import assert_matches, assert_move_as_alone, make_robot, make_sim, step, thrown


def test_two_long_legs(device):
    """The G1 has two legs of six joints: two threads per world."""
    model = make_robot("g1")
    states = thrown(model, 200)
    expected = step_mujoco(model, states)
    assert (expected[2] > 0).any(axis=1).mean() > 0.5
    assert_matches(model, states, step(make_sim(model, 200, device), states), expected)


@pytest.fixture(scope="module")
def crab():
    """A robot with five branches of one to three joints, and cylinders; its states on the floor and in the air."""
    model = compiled(make_crab())
    halves = [draw_states(model, 30, heights) for heights in (FLOOR, AIR)]
    return model, {name: np.concatenate([half[name] for half in halves]) for name in FIELDS}


def test_unlike_legs_under_applied_forces(device, crab):
    """Wrenches on all bodies and forces on all degrees of freedom act as in MuJoCo, and each of them acts."""
    model, states = crab
    assert_applied_forces_act(make_sim(model, len(states["qpos"]), device), model, states)


def test_worlds_do_not_see_each_other(device, crab):
    """With idle threads, too, the first worlds of many move to the bit as they do alone."""
    assert_move_as_alone(*crab, device, 1, 7, prepare=lambda sim: sim.applied_forces())


WORLDS = 300


def touch_each_other(spec):
    """Let all parts that can touch the floor also touch each other."""
    for geom in spec.geoms:
        if geom.conaffinity and geom.name != "floor":
            geom.contype, geom.conaffinity = 2, 3


@pytest.fixture(scope="module")
def folded():
    """An A1 whose parts may touch each other, states with joints anywhere in their ranges, and where parts touch."""
    model, rng = make_robot("a1", touch_each_other), np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (WORLDS, 1))
    qpos[:, 2] = rng.uniform(0.1, 0.4, WORLDS)
    qpos[:, 3:7] += rng.normal(0.0, 0.3, (WORLDS, 4))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qpos[:, 7:] = 1.4 * rng.uniform(*model.jnt_range[1:].T, (WORLDS, model.nu))
    qvel, ctrl = rng.normal(0.0, 1.0, (WORLDS, model.nv)), rng.normal(0.0, 10.0, (WORLDS, model.nu))
    states = {"qpos": qpos, "qvel": qvel, "ctrl": ctrl, "qacc_warmstart": 0.0 * qvel}
    data, counts = mujoco.MjData(model), []
    for data.qpos[:] in qpos:
        mujoco.mj_fwdPosition(model, data)
        counts.append(sum(model.geom_bodyid[pair].all() for pair in data.contact.geom.reshape(-1, 2)))
    return model, states, np.array(counts)


def test_matches_plain_mujoco(device, folded):
    """Legs touch the trunk, and each other, whose equations are solved at once; worlds do not see each other."""
    model, states, counts = folded
    assert (counts > 0).mean() > 0.3 and (counts > 1).mean() > 0.1
    expected, together = step_mujoco(model, states), step(make_sim(model, WORLDS, device), states)
    assert_matches(model, states, together, expected)
    most = np.argsort(counts)[-3:]
    again = step(make_sim(model, WORLDS, device), states)
    alone = step(make_sim(model, 3, device), {name: values[most] for name, values in states.items()})
    for ours, twice, few in zip(together, again, alone, strict=True):
        np.testing.assert_array_equal(ours, twice)
        np.testing.assert_array_equal(ours[most], few)
