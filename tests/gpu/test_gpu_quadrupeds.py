"""The fused step of quadrupeds, four threads per world, against plain MuJoCo. All of them share one kernel."""

import copy
import itertools

import mujoco
import numpy as np
import pytest
import torch
from support.fused import FIELDS, put, random, step_mujoco
from support.on_device import assert_matches, assert_move_as_alone, make_robot, make_sim, results, step, thrown

WORLDS = 200


@pytest.fixture(scope="module")
def a1():
    """The A1 and states of it."""
    model = make_robot("a1")
    return model, thrown(model, WORLDS)


@pytest.mark.parametrize("robot", ["a1", "go1", "go2", "anymal_c"])
def test_matches_plain_mujoco(device, robot):
    """With contacts, friction, joint limits and torques."""
    model = make_robot(robot)
    states = thrown(model, WORLDS)
    expected = step_mujoco(model, states)
    low, high = model.jnt_range[1:].T
    angles = states["qpos"][:, 7:]
    assert (expected[2] > 0).any(axis=1).mean() > 0.7 and ((angles < low) | (angles > high)).any(axis=1).mean() > 0.5
    actual = step(make_sim(model, WORLDS, device), states)
    assert_matches(model, states, actual, expected)


def test_worlds_do_not_see_each_other(device, a1):
    """The first worlds of many move to the bit as they do alone, however many share a group of threads."""
    assert_move_as_alone(*a1, device, 1, 3, 37)


def test_bad_numbers_stay_in_their_world(device, a1):
    """A number that is none, or absurd, leaves the worlds bitwise alone whose threads run next to its own."""
    model, states = a1
    few = {name: values[:16] for name, values in states.items()}
    for field, value in itertools.product(FIELDS, (np.nan, np.inf, 1e30)):
        sims = [make_sim(model, 16, device) for _ in range(2)]
        for sim in sims:
            put(sim, few)
        getattr(sims[0], field)[5, -1] = value
        for _ in range(3):
            for sim in sims:
                sim.step()
        others = np.arange(16) != 5
        for bad, good in zip(*map(results, sims), strict=True):
            np.testing.assert_array_equal(bad[others], good[others])
        for sim in sims:
            sim.reset(torch.tensor(~others, device=device))
            sim.step()
        for bad, good in zip(*map(results, sims), strict=True):
            assert np.isfinite(bad).all()
            np.testing.assert_array_equal(bad, good)


OWN = {  # how each number of a field is changed: by a factor, or by a sum
    "body_mass": ("scale", 0.6, 1.5),
    "geom_friction": ("scale", 0.3, 1.5),
    "dof_armature": ("add", 0.0, 0.05),
    "dof_damping": ("add", 0.0, 1.0),
    "dof_frictionloss": ("add", 0.0, 1.0),
    "gravity": ("scale", 0.9, 1.1),
}


def test_worlds_with_parameters_of_their_own(device, a1):
    """They move as MuJoCo's models with these numbers, and so do the others; inverse weights are mj_setConst's.

    Only the worlds of a mask are changed.
    """
    model, states = a1
    count = 24
    states = {name: values[:count] for name, values in states.items()}
    sim, mask = make_sim(model, count, device), torch.arange(count, device=device) % 2 == 0
    for i, (name, (how, low, high)) in enumerate(OWN.items()):
        field = sim.field(name)
        drawn = torch.tensor(random(tuple(field.shape), low, high, i), dtype=torch.float32, device=device)
        if name.startswith("dof"):
            drawn[:, :6] = 0.0  # the trunk's own joint has none
        if name == "geom_friction":
            drawn = drawn[:, :1, :1].expand_as(field)
        field[mask] = (field * drawn if how == "scale" else field + drawn)[mask]
    sim.update_constants(mask)
    actual = step(sim, states)[0]
    plain = step_mujoco(model, states)[0]
    for world in range(count):
        own = copy.copy(model)
        for name in OWN:
            target = own.opt.gravity if name == "gravity" else getattr(own, name)
            target[:] = sim.field(name)[world].cpu().numpy().reshape(target.shape)
        mujoco.mj_setConst(own, mujoco.MjData(own))
        for name in ("body_invweight0", "dof_invweight0"):
            found = sim.field(name)[world].cpu().numpy()
            np.testing.assert_allclose(found[1:], getattr(own, name)[1:], rtol=1e-4, err_msg=name)
        alone = {name: values[world : world + 1] for name, values in states.items()}
        expected = step_mujoco(own, alone)[0][0]
        np.testing.assert_allclose(actual[world], expected, rtol=0, atol=3e-3, err_msg=f"world {world}")
        assert (np.abs(expected - plain[world]).max() > 1e-2) == (world % 2 == 0)
