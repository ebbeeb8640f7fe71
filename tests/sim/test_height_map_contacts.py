"""Contacts of the fused step with a height map, against planes of plain MuJoCo."""

import functools

import mujoco
import numpy as np
import pytest
from support.fused import assert_alike, compiled, draw_states, make_a1, step_fused, step_mujoco
from support.maps import assert_feet_meet_planes, ball, make_map, simulate, states_on_slope, tilted


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_a_plane_as_a_map(slope):
    """A map of a plane, level or tilted, gives what plain MuJoCo does with the plane; a level one to the last bit."""
    posed, states, height_map = states_on_slope(slope, 150)
    model = compiled(make_a1())
    on_map, on_plane = (step_fused(model, states, height_map=ground) for ground in (height_map, None))
    assert (on_map[2].sum(axis=1) > 0).sum() > 30
    assert_alike(posed, states, on_map, step_mujoco(posed, states))
    if slope == 0.0:
        assert all(np.array_equal(*pair) for pair in zip(on_map, on_plane, strict=True))


def test_slopes_under_each_foot():
    """On slopes that meet in ridges and valleys, each foot meets the plane under it."""
    assert_feet_meet_planes(60)


def test_rest_in_a_groove():
    """A ball in a groove rests on both faces as on MuJoCo's two planes, with the forces that statics give by hand."""
    slopes = (-1.0, 0.5)  # of the left and the right side
    sides = [tilted(slope, 0.0) for slope in slopes]
    height_map = make_map(lambda x, y: np.maximum(slopes[0] * x, slopes[1] * x))
    oracle, model = ball(0.02, planes=[quat for _, _, quat in sides]), ball(0.02)
    angles = np.arctan(np.abs(slopes))
    weight = 9.81 * model.body_mass.sum()
    by_hand = weight * np.sin(angles[::-1]) / np.sin(angles.sum())
    data = mujoco.MjData(oracle)
    data.qpos[[0, 2]] = np.linalg.solve([normal[[0, 2]] for _, normal, _ in sides], [0.1, 0.1])  # where it touches both
    sim = simulate(model, height_map, [data.qpos[:3]], steps=400)
    for _ in range(400):
        mujoco.mj_step(oracle, data)
    assert sim.contact_found.item() == 2.0
    np.testing.assert_allclose(sim.contact_force[0, 0], [0.0, 0.0, weight], rtol=0, atol=1e-3 * weight)
    np.testing.assert_allclose(sim.qpos[0, :3], data.qpos[:3], rtol=0, atol=1e-5)
    for contact in range(2):
        force = np.zeros(6)
        mujoco.mj_contactForce(oracle, data, contact, force)
        assert data.ncon == 2 and abs(force[0] - by_hand[contact]) < 0.02 * weight


def test_cylinders_on_a_level_map():
    """Cylinders that lean on one of their points, or lie on two, move on a level map as plain MuJoCo's on a plane."""
    model, rng = ball(0.6, "cylinder", "0.06 0.05"), np.random.default_rng(3)
    states = draw_states(model, 80, seed=2)
    lean, eighth, yaw = np.where(np.arange(80) % 2, np.pi / 2, rng.uniform(0.5, 1.4, 80)), rng.integers(8, size=80), 0.7
    for qpos, angle, turn in zip(states["qpos"], lean, eighth * np.pi / 4, strict=True):
        turns = ((yaw, 2), (angle, 1), (turn, 2))
        qpos[3:7] = functools.reduce(quat_product, [about_axis(*each) for each in turns])
        qpos[2] = 0.06 * np.sin(angle) + 0.05 * abs(np.cos(angle)) - rng.uniform(-0.001, 0.004)
    expected = step_mujoco(model, states)
    assert set(expected[2][:, 0]) == {0, 1, 2}
    assert_alike(model, states, step_fused(model, states, height_map=make_map(lambda x, y: 0.0 * x)), expected)


def about_axis(angle, axis):
    """The quaternion of a turn about one of the axes."""
    return np.array([np.cos(angle / 2), *np.sin(angle / 2) * np.eye(3)[axis]])


def quat_product(a, b):
    """The product of two quaternions."""
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, a, b)
    return out
