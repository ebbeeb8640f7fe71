"""Robots, states and references for tests of engines."""

import mujoco
import numpy as np
import torch
from support.robot_files import read_robot

from legged_torque import RESOURCES_DIR
from legged_torque.sim.model import build_model
from legged_torque.sim.registry import make_engine
from legged_torque.utils.mjcf import colliding_pairs, read_spec

FIELDS = ("qpos", "qvel", "ctrl", "qacc_warmstart")
AIR, FLOOR, DEEP = (1.0, 2.0), (0.05, 0.3), (-0.4, 0.1)
"""Heights of the trunk [m]: out of reach of the floor, on it, in it."""


def make_a1(edit=None):
    """The specification of the A1, changed by a function."""
    spec = read_spec(RESOURCES_DIR / "robots/a1/a1.xml")
    if edit is not None:
        edit(spec)
    return spec


def make_crab():
    """Five branches of one, two and three joints, some without motors or ranges; cylinders and fixed bodies on both.

    Joints are off their bodies' origins and about odd axes, with springs and references.

    Its settings differ from those of the fused step, but change no motion, and one geom passes through the floor.
    """
    return read_robot("crab")


ROBOTS = {"a1": make_a1, "crab": make_crab}


def compiled(spec):
    """The model with a contact sensor on every colliding geom, and a solver that converges."""
    names = [g.name for g in spec.geoms if g.name and g.name != "floor" and (g.contype or g.conaffinity)]
    model = build_model(spec, names)
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    return model


def draw_states(model, num, heights=FLOOR, seed=0):
    """Random states with torques and warm starts, each up to 10 steps after it was thrown somewhere."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    states = []
    for _ in range(num):
        mujoco.mj_resetData(model, data)
        if model.nkey:
            data.qpos[:] = model.key_qpos[0]
        data.qpos[2] = rng.uniform(*heights)
        data.qpos[3:7] += rng.normal(0.0, rng.choice([0.05, 0.3]), 4)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        data.qpos[7:] += rng.normal(0.0, 0.5, model.njnt - 1)
        data.qvel[:] = rng.normal(0.0, 1.0, model.nv)
        data.ctrl[:] = rng.normal(0.0, 0.7, model.nu) * model.actuator_ctrlrange[:, 1]
        for _ in range(rng.integers(10)):
            mujoco.mj_step(model, data)
        states.append([getattr(data, field).copy() for field in FIELDS])
    return dict(zip(FIELDS, map(np.array, zip(*states, strict=True)), strict=True))


def step_mujoco(model, states, wrenches=None, forces=None):
    """Velocities, positions, contact counts and contact forces after one step of plain MuJoCo, under applied forces."""
    data, result = mujoco.MjData(model), []
    for world in range(len(states["qpos"])):
        mujoco.mj_resetData(model, data)
        for field in FIELDS:
            getattr(data, field)[:] = states[field][world]
        if wrenches is not None:
            data.xfrc_applied[:], data.qfrc_applied[:] = wrenches[world], forces[world]
        mujoco.mj_step(model, data)
        sensors = data.sensordata.reshape(-1, 4).copy()
        result.append((data.qvel.copy(), data.qpos.copy(), sensors[:, 0], sensors[:, 1:]))
    return [np.array(values) for values in zip(*result, strict=True)]


def put(sim, states):
    """Write states into an engine's worlds."""
    for field, values in states.items():
        if field != "qacc_warmstart" or hasattr(sim, field):
            getattr(sim, field).copy_(torch.tensor(values))


SELF_SCRATCH = {"place", "found", "residual", "pushing", "change"}
SELF_SCRATCH |= {"of_pair", "dist", "normal", "jacobian", "joints", "matrix"}


def spoil(sim):
    """Fill outputs and scratch of the fused step with infinities, so that a value which it does not write is found."""
    contacts, selves = sim._scratch.contacts, sim._scratch.selves
    for tensor in (sim.contact_found, sim.contact_force):
        tensor[:, np.isin(sim.mj_model.sensor_refid, colliding_pairs(sim.mj_model))] = np.inf
    arrays = [sim._state.qacc_warmstart, sim._state.solver_niter]
    arrays += [getattr(contacts, name) for name in ("found", "residual", "pushing", "change")]
    arrays += [contacts.normal] if sim._layout.on_map else []
    arrays += [getattr(selves, name) for name in SELF_SCRATCH] if sim._layout.self_kinds else []
    for array in (*arrays, sim._scratch.branch):
        array.numpy().reshape(-1).view(np.float32).fill(np.inf)


def step_fused(model, states, iterations=100, ls_iterations=50, height_map=None, with_forces=False):
    """The same after one fused step, maybe with the kernel that also reads applied forces."""
    sim = make_engine("fused", model, len(states["qpos"]), "cpu", iterations, ls_iterations, height_map)
    if with_forces:
        sim.applied_forces()
    spoil(sim)
    put(sim, states)
    sim.step()
    return [tensor.double().numpy() for tensor in (sim.qvel, sim.qpos, sim.contact_found, sim.contact_force)]


def assert_alike(model, states, actual, expected, worst=2e-3, median=2e-5):
    """Compare velocities, in units of their mean change, positions, contacts (exactly) and forces (to 0.3%)."""
    np.testing.assert_array_equal(actual[2], expected[2])
    scale = np.sqrt(np.mean((expected[0] - states["qvel"]) ** 2))
    error = np.abs(actual[0] - expected[0]).max(axis=1) / scale
    assert error.max() < worst and np.median(error) < median, (error.max(), np.median(error))
    np.testing.assert_allclose(actual[1], expected[1], rtol=0, atol=1e-6 + model.opt.timestep * worst * scale)
    largest = np.maximum(np.abs(expected[3]).max(axis=(1, 2)), 9.81 * model.body_mass.sum())
    assert (np.abs(actual[3] - expected[3]).max(axis=(1, 2)) < 3e-3 * largest).all()


def assert_applied_forces_act(sim, model, states):
    """Wrenches on all bodies and forces on all degrees of freedom act as in MuJoCo, and each of them acts."""
    wrenches = random((len(states["qpos"]), model.nbody, 6), -5.0, 5.0, 1)
    forces = random((len(states["qpos"]), model.nv), -3.0, 3.0, 2)
    without = step_mujoco(model, states)[0]
    for on_bodies, on_joints in ((wrenches, forces), (wrenches, 0.0 * forces), (0.0 * wrenches, forces)):
        put(sim, states)
        for applied, values in zip(sim.applied_forces(), (on_bodies, on_joints), strict=True):
            applied.copy_(torch.tensor(values))
        sim.step()
        expected = step_mujoco(model, states, on_bodies, on_joints)[0]
        error = np.abs(sim.qvel.double().cpu().numpy() - expected).max(axis=1)
        assert np.median(error) < 1e-4 and error.max() < 5e-3, error.max()
        assert (np.abs(expected - without).max(axis=1) > 0.05).all()


def random(size, low, high, seed=0):
    """Random numbers between two limits."""
    return np.random.default_rng(seed).uniform(low, high, size)


def invariants(model, data):
    """Energy [J], angular momentum about the centre of mass [N m s], horizontal momentum [N s]."""
    mujoco.mj_forward(model, data)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    mujoco.mj_subtreeVel(model, data)
    return [data.energy.sum(), *data.subtree_angmom[1], *model.body_mass.sum() * data.subtree_linvel[1][:2]]
