"""The fused step with two and with eight threads per world, some of them idle, against plain MuJoCo."""

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
