"""Contacts with height maps: nearest points of triangles, any ground, and planes of plain MuJoCo."""

import functools

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from support.fused import assert_alike, compiled, draw_states, invariants, make_a1, step_fused, step_mujoco
from support.maps import (
    Map,
    assert_feet_meet_planes,
    ball,
    heights_under,
    make_map,
    pits,
    rough,
    simulate,
    stairs,
    states_on_slope,
    tilted,
)

from legged_torque.envs import task_registry
from legged_torque.sim.fused.surface import SphereContacts, Surface, make_surface, sphere_map
from legged_torque.sim.registry import make_engine
from legged_torque.terrain.rough import RoughGround
from legged_torque.utils.errors import UserError


@wp.kernel(enable_backward=False)
def touch_all(
    surface: Surface,
    centre: wp.array(dtype=wp.vec3),
    radius: wp.array(dtype=float),
    touch: wp.array(dtype=SphereContacts),
):
    """Touch a map with spheres."""
    i = wp.tid()
    touch[i] = sphere_map(surface, centre[i], radius[i])


def touches(height_map, centres, radii):
    """Where spheres touch a map."""
    with wp.ScopedDevice("cpu"):
        out = wp.empty(len(centres), dtype=SphereContacts)
        places, sizes = wp.array(centres, dtype=wp.vec3), wp.array(radii, dtype=float)
        wp.launch(touch_all, len(centres), [make_surface(height_map), places, sizes, out])
    return out.numpy()


def samples(height_map, per_cell=40):
    """Many points of a map's triangles, exact heights of both halves of all cells. Shape: (points, 3)."""
    heights, scale, corner = height_map
    x, y = (values.ravel() for values in np.meshgrid(*[np.linspace(0.0, 1.0, per_cell + 1)] * 2, indexing="ij"))
    points = []
    for i, j in np.ndindex(heights.shape[0] - 1, heights.shape[1] - 1):
        a, b, c, d = heights[i, j], heights[i + 1, j], heights[i, j + 1], heights[i + 1, j + 1]
        z = np.where(x >= y, a + (b - a) * x + (d - b) * y, a + (c - a) * y + (d - c) * x)
        points.append(np.stack([corner[0] + scale * (i + x), corner[1] + scale * (j + y), z], axis=1))
    return np.concatenate(points)


def test_nearest_point_of_rough_ground():
    """Distance and normal of spheres and points above and below random ground are those to its nearest point."""
    rng = np.random.default_rng(0)
    height_map = Map(rng.uniform(-0.03, 0.05, (9, 8)).astype(np.float32), 0.05, (-0.3, 0.2))
    centres = np.stack([rng.uniform(*limits, 300) for limits in ((-0.25, 0.05), (0.25, 0.5), (-0.04, 0.09))], axis=1)
    radii = np.where(rng.random(300) < 0.3, 0.0, rng.uniform(0.01, 0.06, 300))
    touch, ground = touches(height_map, centres, radii), samples(height_map)
    for centre, radius, found in zip(centres, radii, touch, strict=True):
        apart = np.linalg.norm(ground - centre, axis=1)
        nearest, under = ground[apart.argmin()], ground[np.linalg.norm((ground - centre)[:, :2], axis=1).argmin()]
        side = np.sign(centre[2] - under[2])
        dist = side * apart.min() - radius
        if found["count"] == 0:
            assert dist > -5e-4
            continue
        assert abs(found["dist"][0] - dist) < 1e-3
        np.testing.assert_allclose(apart.min() * found["first"], side * (centre - nearest), rtol=0, atol=2e-3)
    assert 0.2 < (touch["count"] == 0).mean() < 0.6 and (touch["count"] == 2).any()


@pytest.mark.parametrize("slope", [0.0, 0.3, 1.0, 3.0])
def test_triangles_of_a_plane_are_one_plane(slope):
    """Spheres and points near a triangulated plane touch it with its normal, once, wherever they are."""
    along, normal, _ = tilted(slope, 0.4)
    rng = np.random.default_rng(1)
    height_map = make_map(lambda x, y: along[0] * x + along[1] * y, cells=20)
    radii, dist = rng.choice([0.0, 0.02, 0.1], 2000), rng.uniform(-0.03, 0.005, 2000)
    places = rng.uniform(-0.3, 0.3, (2000, 2))
    places[:700] = np.round(places[:700] / 0.05) * 0.05  # above samples, and then above edges
    places[700:1000, 0] = np.round(places[700:1000, 0] / 0.05) * 0.05
    centres = np.column_stack([places, places @ along]) + (radii + dist)[:, None] * normal
    touch = touches(height_map, centres, radii)
    np.testing.assert_array_equal(touch["count"], np.where(dist < 0.0, 1, 0))
    touching = touch["count"] == 1
    np.testing.assert_allclose(touch["dist"][touching, 0], dist[touching], rtol=0, atol=1e-6)
    np.testing.assert_allclose(touch["first"][touching], np.tile(normal, (touching.sum(), 1)), rtol=0, atol=2e-6)


def circle_point(radius, eighth):
    """A point of a circle around the origin."""
    return radius * np.cos(np.pi / 4 * eighth), radius * np.sin(np.pi / 4 * eighth)


@pytest.mark.parametrize("ground", [stairs, pits, rough])
@pytest.mark.parametrize(
    ("kind", "size"), [("capsule", "0.03 0.1"), ("cylinder", "0.06 0.05"), ("box", "0.1 0.06 0.04")]
)
def test_nothing_falls_through(kind, size, ground):
    """What hits stairs, pits and rough ground at 5 m/s, straight or aslant, comes to lie on it and wins no energy."""
    rng = np.random.default_rng(4)
    height_map, model = make_map(ground), ball(0.5, kind, size)
    places = np.column_stack([rng.uniform(-1.0, 1.0, (100, 2)), np.full(100, 1.2)])
    velocities = np.column_stack([rng.uniform(-3.0, 3.0, (100, 2)), np.full(100, -5.0)])
    velocities[:30, :2] = 0.0
    sim = simulate(model, height_map, places, velocities)
    sim.qvel[:, 3:6] = torch.tensor(rng.normal(0.0, 3.0, (100, 3)))
    data, start = mujoco.MjData(model), None
    sizes = model.geom("ball").size
    half = sizes if kind == "box" else sizes[1] * np.array([0.0, 0.0, 1.0])
    across = 9 if kind == "capsule" else 2  # all along the axis of a capsule
    corners = half * (np.array(list(np.ndindex(across, across, across))) * 2.0 / (across - 1.0) - 1.0)
    if kind == "cylinder":
        corners = np.array([(*circle_point(sizes[0], i), z) for i in range(8) for z in (-sizes[1], sizes[1])])
    for _ in range(9):
        energies, points = [], []
        for data.qpos[:], data.qvel[:] in zip(sim.qpos, sim.qvel, strict=True):
            energies.append(invariants(model, data)[0])
            points.append(data.geom("ball").xpos + corners @ data.geom("ball").xmat.reshape(3, 3).T)
        start = start or energies
        assert (np.array(energies) < np.array(start) + 0.01).all()
        for _ in range(50):
            sim.step()
    above = np.array(points)[..., 2] - heights_under(height_map, np.array(points))
    assert above.min() > (-0.03 if kind in ("box", "cylinder") else 0.0)  # under a riser's edge: 5 mm from its face
    assert np.mean(above.min(axis=1) < 0.1) > 0.9


def test_beyond_the_border():
    """Outside of the map the ground goes on as high as its border."""
    height_map = make_map(lambda x, y: np.where(x > 0.0, 0.2, 0.0) + 0.0 * y, cells=20)
    sim = simulate(ball(0.5), height_map, [[3.0, 0.1, 0.5], [-3.0, 40.0, 0.5], [0.2, -0.5, 0.5]], steps=300)
    np.testing.assert_allclose(sim.qpos[:, 2], [0.3, 0.1, 0.3], rtol=0, atol=0.01)
    assert (sim.contact_found == 1.0).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e30])
def test_bad_numbers_stay_in_their_world(value):
    """A world with a place that is none, or absurd, leaves the others bitwise alone."""
    places = np.random.default_rng(6).uniform(-1.0, 1.0, (6, 3))
    sims = [simulate(ball(0.5), make_map(rough), places) for _ in range(2)]
    for axis in range(3):
        sims[1].qpos[axis, axis] = value
    for sim in sims:
        for _ in range(50):
            sim.step()
    assert torch.equal(sims[0].qpos[3:], sims[1].qpos[3:]) and torch.isfinite(sims[0].qpos).all()


def test_refused():
    """Heights are the world's: a floor that is or goes elsewhere cannot be a map; other engines have their own way."""
    spec, height_map = make_a1(), make_map(rough)
    with pytest.raises(UserError, match="'mujoco_warp' lacks the capability 'height_map'"):
        make_engine("mujoco_warp", compiled(spec), 1, "cpu", height_map=height_map)
    sim = make_engine("fused", compiled(spec), 2, "cpu", height_map=height_map)
    sim.field("geom_pos", [2 + 3 * sim.mj_model.geom("FR_foot").id])
    with pytest.raises(UserError, match="does not read 'geom_pos' of the floor"):
        sim.field("geom_pos", [2 + 3 * sim.mj_model.geom("floor").id])
    spec.geom("floor").pos = [0.0, 0.0, 0.1]
    with pytest.raises(UserError, match="its floor is not at the origin"):
        make_engine("fused", compiled(spec), 1, "cpu", height_map=height_map)


def test_a_gpu_without_room(monkeypatch):
    """A map that does not fit a GPU's memory is refused before it is made: three times 2601 x 4201 float32 here."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (2**20, 2**30))
    with pytest.raises(UserError, match="needs 135 MiB, and cuda:0 has 1 left"):
        RoughGround(task_registry.get_cfgs("a1_position")[0].terrain, 1, "cuda:0")


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
