"""The batched simulator against plain MuJoCo in double precision, and what it promises about sensors and resets."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.simulator import CONVERGED, LEGS, SENSED, WEIGHT, contacts_by_hand

from legged_torque.sim import mjwarp
from legged_torque.sim.registry import ENGINES, make_engine

FEET = [i for i, name in enumerate(SENSED) if name.endswith("foot")]
LEG_UP = (0.0, 2.6, -0.95)
"""Angles of a leg that points up, away from the floor."""

STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "contact_found", "contact_force")


def copy_state(sim, world, data):
    """Write one world's state, torques and warm start into plain MuJoCo's data."""
    for field in ("qpos", "qvel", "qacc_warmstart", "ctrl"):
        getattr(data, field)[:] = getattr(sim, field)[world].numpy()


def steep_capsule_touches(model, data):
    """Whether a capsule touches the floor at more than about 60 degrees.

    MuJoCo turns the contact's tangents along the capsule, MuJoCo Warp falls back to the world's axes there. With a
    pyramidal friction cone this gives another, equally valid approximation, which is no matter of accuracy.
    """
    capsules = (g for g in data.contact.geom.ravel() if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE)
    return any(abs(data.geom_xmat[g][8]) > 0.85 for g in capsules)


def scatter(task, generator):
    """Put worlds into different states: low and high, bent and moving."""
    n = task.num_envs
    task.base_pos[:, 2] = torch.linspace(0.2, 0.4, n)
    task.dof_pos.copy_(task.default_dof_pos + 0.1 * torch.randn(n, 12, generator=generator))
    task.sim.qvel.copy_(0.3 * torch.randn(n, 18, generator=generator))


def random_torques(sim, generator):
    """Draw torques that throw the robot about, within its limits."""
    sim.ctrl.copy_(8.0 * torch.randn(sim.ctrl.shape, generator=generator).clamp(-4.0, 4.0))


@pytest.fixture(scope="module", params=ENGINES)
def standing(make_task, request):
    """Worlds that have stood still for 1.6 s under the default solver settings, the last one far above the ground."""
    level = {f"domain_rand.init_{angle}": [0.0, 0.0] for angle in ("roll", "pitch")}
    start = {"domain_rand.init_dof_pos_scale": [1.0, 1.0], "sim.engine": request.param}
    task = make_task("a1_position", 3, **level, **start)
    task.base_pos[:, 2] = torch.tensor([0.31, 0.31, 100.0])
    for _ in range(80):
        task.step(torch.zeros(3, 12))
    return task


# --------------------------------------------------------------------------------------------------- physics


@pytest.mark.parametrize(
    ("engine", "resync", "tolerance"),
    [("fused", 1, 2e-3), ("fused", 5, 5e-3), ("mujoco_warp", 1, 1e-2), ("mujoco_warp", 5, 3e-2)],
)
def test_matches_plain_mujoco(make_task, engine, resync, tolerance):
    """Over 200 steps of random torques every world moves as plain MuJoCo does from the same state.

    The reference starts anew from the world's state every ``resync`` steps. ``tolerance`` is for the worst velocity
    [m/s, rad/s] in the worst step, when contacts begin or slip; half of all steps must be 100 times as accurate and
    more. Positions must agree to the tolerance times the physics step, contacts exactly, their forces to 1%.
    """
    generator = torch.Generator().manual_seed(2)
    task = make_task("a1_torque", 4, **CONVERGED, **{"sim.engine": engine})
    sim, model = task.sim, task.sim.mj_model
    scatter(task, generator)
    references = [mujoco.MjData(model) for _ in range(4)]
    errors, in_contact = [], 0
    comparable = [True] * 4
    for step in range(200):
        random_torques(sim, generator)
        for world, data in enumerate(references):
            if step % resync == 0:
                copy_state(sim, world, data)
                comparable[world] = True
            data.ctrl[:] = sim.ctrl[world].numpy()
            mujoco.mj_step(model, data)
            comparable[world] &= engine == "fused" or not steep_capsule_touches(model, data)
        sim.step()
        for world, data in enumerate(references):
            if not comparable[world]:
                continue
            in_contact += data.ncon > 0
            where = f"step {step}, world {world}"
            errors.append(np.abs(sim.qvel[world].numpy() - data.qvel).max())
            np.testing.assert_allclose(sim.qvel[world], data.qvel, rtol=0, atol=tolerance, err_msg=where)
            np.testing.assert_allclose(sim.qpos[world], data.qpos, rtol=0, atol=0.005 * tolerance, err_msg=where)
            found, force = contacts_by_hand(model, data)
            np.testing.assert_array_equal(sim.contact_found[world], found, err_msg=where)
            error = np.abs(sim.contact_force[world].numpy() - force).max()
            assert error <= 0.01 * max(np.abs(force).max(), WEIGHT), where
    assert np.median(errors) < (1e-5 if engine == "fused" else 5e-5)
    assert len(errors) > (0.99 if engine == "fused" else 0.85) * 800 and in_contact > 0.5 * 800


@pytest.mark.parametrize("engine", ENGINES)
def test_worlds_do_not_interact(make_task, engine):
    """A world in contact moves bitwise alike whatever its neighbours do."""
    generator = torch.Generator().manual_seed(0)
    torques = 8.0 * torch.randn(20, 12, generator=generator)
    trajectories = []
    for height in (0.15, 5.0):
        task = make_task("a1_torque", 2, **{"sim.engine": engine})
        task.base_pos[:, 2] = torch.tensor([height, 0.25])
        for torque in torques:
            task.sim.ctrl.copy_(torque)
            task.sim.step()
        trajectories.append(torch.cat([task.sim.qpos, task.sim.qvel], dim=1))
    assert task.sim.contact_found[1].any()
    assert not torch.equal(trajectories[0][0], trajectories[1][0])
    assert torch.equal(trajectories[0][1], trajectories[1][1])


# --------------------------------------------------------------------------------------------------- contact sensors


def test_standing_robot_presses_its_weight(standing):
    """The forces on the feet of a standing robot point up and sum up to its weight, their horizontal parts to 0."""
    force = standing.sim.contact_force[:2]
    assert (force[:, FEET, 2] > 5.0).all()
    np.testing.assert_allclose(force[:, :, 2].sum(dim=1), WEIGHT, rtol=0.02)
    np.testing.assert_allclose(force[:, :, :2].sum(dim=1), 0.0, atol=0.02 * WEIGHT)
    assert (standing.base_pos[:2, 2] > 0.22).all()


def test_what_does_not_touch_feels_nothing(standing):
    """Standing, everything but the feet has no contact and no force; in the air, so have the feet."""
    others = [i for i in range(len(SENSED)) if i not in FEET]
    found, force = standing.sim.contact_found, standing.sim.contact_force
    assert (found[:2][:, FEET] == 1).all()
    assert (found[:2][:, others] == 0).all() and (force[:2][:, others] == 0).all()
    assert (found[2] == 0).all() and (force[2] == 0).all()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("height", "leg_angles", "parts"),
    [
        (0.053, LEG_UP, ()),  # the trunk is 0.057 m thick below its origin
        (0.333, (0.0, 0.0, -0.95), ("foot",)),  # 0.2 + 0.2 cos(0.95) + 0.02 = 0.3363 m below the trunk
        (0.213, (0.0, 0.0, -2.6), ("thigh",)),  # its end is 0.217 m below the trunk, the calf's 0.21 m
        (0.207, (0.0, 0.0, -2.6), ("thigh", "calf")),
    ],
)
def test_contact_columns(make_task, engine, height, leg_angles, parts):
    """In world i only leg i reaches the floor, with known parts: exactly these parts' columns say so."""
    sim = make_task("a1_torque", 4, **{"sim.engine": engine}).sim
    for world in range(4):
        angles = [LEG_UP] * 4
        angles[world] = leg_angles
        sim.qpos[world] = torch.tensor([0, 0, height, 1, 0, 0, 0, *np.ravel(angles)])
    sim.step()
    for world, leg in enumerate(LEGS):
        touching = {SENSED[i] for i in sim.contact_found[world].nonzero().flatten()}
        assert touching == ({f"{leg}_{part}" for part in parts} or {"trunk"})
        pressed = {SENSED[i] for i in sim.contact_force[world, :, 2].nonzero().flatten()}
        assert pressed and pressed <= touching and (sim.contact_force[world, :, 2] >= 0).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_steps_that_do_not_sense(make_task, engine):
    """Steps without sensing move the worlds bitwise alike; a step that senses after them senses the same.

    Between, the sensors keep what the last step that sensed has written; MuJoCo Warp's own step sets them to zero.
    """
    generator = torch.Generator().manual_seed(5)
    tasks = [make_task("a1_torque", 2, **{"sim.engine": engine}) for _ in range(2)]
    sims = [task.sim for task in tasks]
    for task in tasks:
        task.sim.qpos[:, 2] = 0.25
        task.dof_pos.copy_(task.default_dof_pos.expand(2, -1))  # touches the ground, whatever was drawn
    for sense in (True, False, False, True):
        kept = [sims[1].contact_found.clone(), sims[1].contact_force.clone()]
        torque = 8.0 * torch.randn(2, 12, generator=generator)
        for sim, senses in zip(sims, (True, sense), strict=True):
            sim.ctrl.copy_(torque)
            sim.step(senses)
        assert torch.equal(sims[0].qpos, sims[1].qpos) and torch.equal(sims[0].qvel, sims[1].qvel)
        for before, name in zip(kept, ("contact_found", "contact_force"), strict=True):
            sensed, after = getattr(sims[0], name), getattr(sims[1], name)
            assert sensed.any()
            if sense:
                expected = sensed
            else:
                assert before.any() or engine == "mujoco_warp"
                expected = before if engine == "fused" else torch.zeros_like(before)
            assert torch.equal(after, expected)
        assert sense or not torch.equal(sims[0].contact_force, sims[1].contact_force)


# --------------------------------------------------------------------------------------------------- buffers

WITH_BUFFERS = {"sim.engine": "mujoco_warp"}
"""The engine that has buffers for contacts and constraints; the fused step has room for all."""


def put_deep_into_the_floor(sim):
    """Fill the buffers: every geom in the floor at all its points, every joint beyond a limit."""
    sim.qpos[:] = torch.tensor([0, 0, -0.3, 1, 0, 0, 0, *(1.0, -1.2, -2.8) * 4])
    sim.qvel.zero_()


def test_buffers_suffice_for_the_worst_case(make_task):
    """With all contacts and all limits active at once, in all worlds, nothing is dropped."""
    sim = make_task("a1_torque", 3, **WITH_BUFFERS).sim
    put_deep_into_the_floor(sim)
    sim.step()
    sim.flag_diverged()
    assert sim.check_buffers() is None
    for world in range(3):
        found = dict(zip(SENSED, sim.contact_found[world].tolist(), strict=True))
        assert found.pop("trunk") >= 4
        assert found == {name: 1 if name.endswith(("foot", "hip")) else 2 for name in found}  # spheres and capsules


def test_buffers_suffice_in_normal_use(make_task):
    """A task whose robots fall over and are reset reports no overflow."""
    task = make_task("a1_torque", 4, **WITH_BUFFERS)
    for _ in range(30):
        task.step(3.0 * torch.randn(4, 12))
    assert task.sim.check_buffers() is None


@pytest.mark.parametrize("buffer", ["max_contacts", "max_constraints"])
def test_full_buffers_are_reported(make_task, monkeypatch, buffer):
    """A buffer that is too small in one world is named, even after that world has been reset."""
    model = make_task("a1_torque", 1).sim.mj_model
    monkeypatch.setattr(mjwarp, buffer, lambda *_: {"max_contacts": 6, "max_constraints": 20}[buffer])
    sim = make_engine("mujoco_warp", model, 2, "cpu", solver_iterations=5, ls_iterations=8)
    put_deep_into_the_floor(sim)
    sim.qpos[:, 2], sim.qpos[:, 7:] = 10.0, torch.tensor(LEG_UP * 4)
    sim.step()
    sim.flag_diverged()
    assert sim.check_buffers() is None  # nothing touches the floor, and no joint is at its limit
    put_deep_into_the_floor(sim)
    sim.qpos[0, 2] = 10.0
    sim.step()
    sim.flag_diverged()
    sim.reset(torch.tensor([True, True]))
    sim.step()
    sim.flag_diverged()
    expected = {"max_contacts": "NARROWPHASE", "max_constraints": "NEFC"}[buffer]
    assert expected in sim.check_buffers()


# --------------------------------------------------------------------------------------------------- resets, divergence


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("worlds", [[0], [1, 3], [0, 1, 2, 3]])
def test_reset_touches_only_masked_worlds(make_task, engine, worlds):
    """A reset puts the masked worlds at rest into the reference pose; the others go on as if nothing had happened."""
    generator = torch.Generator().manual_seed(4)
    task, twin = (make_task("a1_torque", 4, **{"sim.engine": engine}) for _ in range(2))
    for each in (task, twin):
        scatter(each, torch.Generator().manual_seed(3))
        each.base_pos[:, 2] = 0.15  # legs in the floor
    for _ in range(3):
        random_torques(task.sim, generator)
        twin.sim.ctrl.copy_(task.sim.ctrl)
        task.sim.step()
        twin.sim.step()
    assert twin.sim.contact_found.any(dim=1).all()
    mask = torch.zeros(4, dtype=torch.bool)
    mask[worlds] = True
    task.sim.reset(mask)
    for field in STATE:
        after, before = getattr(task.sim, field), getattr(twin.sim, field)
        assert torch.equal(after[~mask], before[~mask]), field
        if field != "qpos":
            assert (before[mask] != 0).any() and (after[mask] == 0).all(), field
    nominal = [0.0, 0.0, 0.303, 1.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(task.sim.qpos[mask][:, :7], [nominal] * len(worlds), atol=1e-6)
    for _ in range(5):
        random_torques(task.sim, generator)
        twin.sim.ctrl.copy_(task.sim.ctrl)
        task.sim.step()
        twin.sim.step()
    for field in STATE:
        assert torch.equal(getattr(task.sim, field)[~mask], getattr(twin.sim, field)[~mask]), field


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 1e12])
@pytest.mark.parametrize("field", ["qpos", "qvel", "qacc_warmstart"])
def test_divergence_is_flagged(make_task, field, value):
    """One bad number anywhere in the state flags its world and no other, until the flags are cleared."""
    sim = make_task("a1_torque", 3).sim
    sim.flag_diverged()
    assert not sim.diverged.any()
    state = getattr(sim, field)
    for entry in (0, state.shape[1] - 1):
        good = state[1, entry].clone()
        state[1, entry] = value
        sim.flag_diverged()
        state[1, entry] = good
        sim.flag_diverged()
        assert sim.diverged.tolist() == [False, True, False]
        sim.clear_diverged()
        assert not sim.diverged.any()


def test_ordinary_speed_is_no_divergence(make_task):
    """Fast but possible motion, and the large accelerations of an impact, are not taken for divergence."""
    sim = make_task("a1_torque", 1).sim
    sim.qpos[0, :2], sim.qvel[0, 6:], sim.qacc_warmstart[0, 6:] = 1000.0, 100.0, 1e6
    sim.flag_diverged()
    assert not sim.diverged.any()


def rotation_matrices(roll, pitch, yaw):
    """Rotations about the world's x, then y, then z axis."""
    result = []
    for r, p, y in zip(roll, pitch, yaw, strict=True):
        about_x = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
        about_y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
        about_z = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
        result.append(about_z @ about_y @ about_x)
    return np.array(result)


def test_orientation(make_task):
    """Roll, pitch and yaw are rotations about the world's axes in this order, in the worlds of the mask."""
    ranges = {f"domain_rand.init_{name}": [-math.pi, math.pi] for name in ("roll", "pitch", "yaw")}
    task = make_task("a1_torque", 50, **ranges)
    mask = torch.arange(50) % 2 == 0
    before, angles = task.sim.qpos.clone(), task.init_angles.clone()
    task.events.happen(mask)
    assert torch.equal(task.sim.qpos[~mask], before[~mask]) and torch.equal(task.init_angles[~mask], angles[~mask])
    assert not torch.isclose(task.init_angles[mask], angles[mask]).all(dim=1).any()
    angles = task.init_angles[mask].double().numpy()
    for quat, expected in zip(task.sim.qpos[mask, 3:7].double(), rotation_matrices(*angles.T), strict=True):
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, quat.numpy())
        np.testing.assert_allclose(matrix.reshape(3, 3), expected, atol=1e-6)
