"""Contacts of the fused step with a height map, against planes of plain MuJoCo."""

import functools

import mujoco
import numpy as np
import pytest
from support.fused import assert_alike, compiled, draw_states, make_a1, step_fused, step_mujoco
from support.maps import ball, make_map, simulate, tilted


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_a_plane_as_a_map(slope):
    """A map of a plane, level or tilted, gives what plain MuJoCo does with the plane; a level one to the last bit.

    Of boxes that are more than half in it, MuJoCo lets only the lower corners touch: those are not compared.
    """
    along, normal, quat = tilted(slope, 0.7)
    model, posed = compiled(make_a1()), make_a1()
    posed.geom("floor").quat = quat
    posed = compiled(posed)
    states = draw_states(posed, 150, (0.05, 0.4))
    data, boxes = mujoco.MjData(posed), posed.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    kept = []
    for data.qpos[:] in states["qpos"]:
        mujoco.mj_kinematics(posed, data)
        kept.append((data.geom_xpos[boxes] @ normal > 0.0).all())
    states = {field: values[kept] for field, values in states.items()}
    height_map = make_map(lambda x, y: along[0] * x + along[1] * y)
    on_map, on_plane = (step_fused(model, states, height_map=ground) for ground in (height_map, None))
    assert (on_map[2].sum(axis=1) > 0).sum() > 30
    assert_alike(posed, states, on_map, step_mujoco(posed, states))
    if slope == 0.0:
        assert all(np.array_equal(*pair) for pair in zip(on_map, on_plane, strict=True))


def on_facets(height_map, num):
    """States of the A1 whose touching feet are over the inside of a triangle, and those triangles as plane's poses.

    Only feet touch. Returns the model, the oracle with a plane per foot, states, and its results.
    """
    heights, scale, corner = height_map
    model, spec = make_a1(feet_only), make_a1(feet_only)
    feet = [geom.name for geom in spec.geoms if geom.name.endswith("foot")]
    floor = spec.geom("floor")
    floor.contype = 0
    for k, foot in enumerate(feet):
        spec.geom(foot).conaffinity = 2 << k
        spec.worldbody.add_geom(name=f"under_{foot}", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=2 << k)
        plane = spec.geom(f"under_{foot}")
        plane.conaffinity, plane.pos, plane.quat = 0, [0.1, 0.2, 0.3], [1.0, 0.1, 0.2, 0.3]  # else fixed for good
        plane.friction, plane.solref, plane.solimp, plane.condim = floor.friction, floor.solref, floor.solimp, 3
    model, oracle = compiled(model), compiled(spec)
    data, kept, results = mujoco.MjData(oracle), [], []
    rng = np.random.default_rng(3)
    while len(kept) < num:
        mujoco.mj_resetData(oracle, data)
        data.qpos[:] = oracle.key_qpos[0]
        data.qpos[:2], data.qpos[3:7] = rng.uniform(-1.0, 1.0, 2), [1.0, *rng.normal(0.0, 0.06, 3)]
        data.qpos[7:] += rng.normal(0.0, 0.15, 12)
        data.qvel[:], data.ctrl[:] = rng.normal(0.0, 0.7, oracle.nv), rng.normal(0.0, 10.0, oracle.nu)
        mujoco.mj_kinematics(oracle, data)
        poses, inside, gaps = [], [], []
        for foot in feet:
            centre = data.geom(foot).xpos
            (i, x), (j, y) = (divmod((centre[k] - corner[k]) / scale, 1.0) for k in range(2))
            i, j = int(i), int(j)
            first, last = heights[i, j], heights[i + 1, j + 1]
            other = heights[i + 1, j] if x >= y else heights[i, j + 1]
            slopes = np.array([other - first, last - other] if x >= y else [last - other, other - first]) / scale
            normal = np.array([*-slopes, 1.0]) / np.sqrt(1.0 + slopes @ slopes)
            point = np.array([corner[0] + i * scale, corner[1] + j * scale, first])
            gaps.append(normal @ (centre - point) - 0.02)
            poses.append((point, normal))
            x, y = ((centre - 0.02 * normal - point) / scale)[:2]
            inside.append(min(abs(x - y) / np.sqrt(2.0), x, y, 1.0 - x, 1.0 - y) * scale)
        lift = -min(gaps) - rng.uniform(0.0, 0.04)
        data.qpos[2] += lift
        if min(np.array(inside)[np.array(gaps) + lift < 0.03]) < 0.03:
            continue
        for foot, (point, normal) in zip(feet, poses, strict=True):
            quat = np.array([1.0 + normal[2], -normal[1], normal[0], 0.0])
            geom = oracle.geom(f"under_{foot}").id
            oracle.geom_pos[geom], oracle.geom_quat[geom] = point, quat / np.linalg.norm(quat)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        kept.append([data.qpos.copy(), data.qvel.copy(), data.ctrl.copy(), np.zeros(oracle.nv)])
        mujoco.mj_step(oracle, data)
        results.append((data.qvel.copy(), data.ncon))
    fields = zip(*kept, strict=True)
    return model, dict(zip(("qpos", "qvel", "ctrl", "qacc_warmstart"), map(np.array, fields), strict=True)), results


def feet_only(spec):
    """Let nothing but feet reach the ground: all else that collides is tiny and at the joints."""
    for geom in spec.geoms:
        if geom.conaffinity and not geom.name.endswith("foot") and geom.name != "floor":
            geom.size, geom.pos = [1e-3, 1e-3, 1e-3], [0.0, 0.0, 0.0]


def test_slopes_under_each_foot():
    """On random slopes, away from their edges, the A1 moves as in plain MuJoCo with a plane posed under each foot."""
    rng = np.random.default_rng(2)
    height_map = make_map(lambda x, y: rng.uniform(-0.08, 0.08, x.shape), scale=0.4, cells=8)
    model, states, results = on_facets(height_map, 60)
    found = step_fused(model, states, height_map=height_map)
    counts = np.array([count for _, count in results])
    np.testing.assert_array_equal(found[2].sum(axis=1), counts)
    assert np.mean(counts > 1) > 0.1
    np.testing.assert_allclose(found[0], [qvel for qvel, _ in results], rtol=0, atol=1e-4)


def test_sliding_over_triangles():
    """A ball that slides and rolls over a triangulated slope moves for 300 steps as on plain MuJoCo's tilted plane."""
    along, normal, quat = tilted(0.4, 0.3)
    height_map = make_map(lambda x, y: along[0] * x + along[1] * y, cells=200)
    for friction in (0.1, 0.6):
        oracle = ball(friction, planes=[quat])
        data = mujoco.MjData(oracle)
        data.qpos[:3], data.qvel[:3] = 0.0995 * normal, [0.5, 1.5, 0.0]
        sim = simulate(ball(friction), height_map, [data.qpos[:3]], data.qvel[:3])
        start = data.qpos[:2].copy()
        for _ in range(250):
            sim.step()
            mujoco.mj_step(oracle, data)
        np.testing.assert_allclose(sim.qvel[0, :6], data.qvel[:6], rtol=0, atol=5e-4)
        np.testing.assert_allclose(sim.qpos[0, :3], data.qpos[:3], rtol=0, atol=2e-4)
        assert np.linalg.norm(data.qpos[:2] - start) > 1.5  # over some 30 cells


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
