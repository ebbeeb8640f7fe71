"""Robots, states and references for tests of engines."""

import mujoco
import numpy as np
import torch

from legged_torque import RESOURCES_DIR
from legged_torque.sim.model import build_model
from legged_torque.sim.registry import make_engine
from legged_torque.utils.mjcf import colliding_pairs, read_spec

FIELDS = ("qpos", "qvel", "ctrl", "qacc_warmstart")
AIR, FLOOR, DEEP = (1.0, 2.0), (0.05, 0.3), (-0.4, 0.1)
"""Heights of the trunk [m]: out of reach of the floor, on it, in it."""
WALKER = """<mujoco><compiler angle="radian" autolimits="true"/>
<option cone="pyramidal" integrator="implicitfast" impratio="10" timestep="0.004"/>
<default><joint armature="0.02" frictionloss="0.1" damping="0.3" stiffness="4" springref="0.2" range="-1 1"/>
<geom contype="0" conaffinity="1"/><motor ctrlrange="-20 20" forcerange="-15 15"/></default>
<worldbody><geom name="floor" type="plane" size="0 0 1" contype="1" conaffinity="0" friction="0.7"/>
<body name="trunk" pos="0.1 0.2 0.3" quat="1 0.1 0.2 0.3"><freejoint/>
 <geom name="hull" type="capsule" size="0.06 0.1" quat="1 1 0.1 0" mass="4"/>
 <geom name="tail" type="sphere" size="0.05" pos="-0.1 0 0.02" mass="1"/>
 <geom name="nose" type="box" size="0.03 0.04 0.02" pos="0.12 0 0" quat="1 0 0.3 0" mass="0.5"/>{legs}</body>
</worldbody><actuator>{motors}</actuator></mujoco>"""
WALKER_LEG = """<body pos="0 {y} -0.05" quat="1 0.2 0 {y}">
 <joint name="{s}1" axis="1 0 0.2" pos="0.01 0.02 0.03"/><geom name="{s}hip" type="sphere" size="0.03" mass="0.5"/>
 <body pos="0.02 0 -0.04" quat="1 0 -0.3 0"><joint name="{s}2" axis="0.1 1 0" pos="0 0 0.02" ref="0.1"/>
  <geom name="{s}thigh" type="capsule" size="0.02" fromto="0 0 0 0.02 0 -0.12" mass="0.4"/>
  <body pos="0.02 0 -0.13"><joint name="{s}3" axis="0 1 0" damping="0"/>
   <geom name="{s}shin" type="capsule" size="0.015" fromto="0 0 0 0 0 -0.1" mass="0.2"/>
   <body pos="0 0 -0.12" quat="1 0 0.2 0.1"><joint name="{s}4" axis="0.3 1 0.5" frictionloss="0" pos="0 0 -0.01"/>
    <geom name="{s}foot" type="box" size="0.05 0.03 0.015" pos="0.02 0 -0.01" quat="1 0.1 0 0" mass="0.3"/>
 </body></body></body></body>"""
CRAB = """<mujoco><compiler angle="radian" autolimits="true"/>
<option cone="pyramidal" integrator="Euler" impratio="10" timestep="0.004">
 <flag midphase="disable" autoreset="disable" fwdinv="enable" invdiscrete="enable"/></option>
<default><joint armature="0.01" frictionloss="0.1" damping="0.5" range="-0.8 0.6"/><motor ctrlrange="-9 9"/>
 <geom contype="0" conaffinity="1" condim="1"/></default>
<worldbody><geom name="floor" type="plane" size="0 0 1" contype="1" conaffinity="0" condim="3" solref="0.015 0.9"/>
<body name="trunk" pos="0 0 0.3"><freejoint/><geom name="drum" type="cylinder" size="0.1 0.04" mass="3"/>
 <geom name="box" type="box" size="0.15 0.06 0.02" mass="1"/>
 <body name="head" pos="0.1 0 0.05" euler="0 0.4 0">
  <geom name="head" type="cylinder" size="0.03 0.05" mass="0.5"/></body>
 <body name="wheel" pos="0.1 0.1 -0.05"><joint axis="0 1 0.1" name="wheel" limited="false"/>
  <geom name="tyre" type="cylinder" size="0.07 0.02" euler="1.57 0.1 0" mass="0.6"/></body>
 <body name="tail" pos="-0.1 0 0" euler="0 0 0.3"><joint axis="0 1 0"/>
  <geom name="tail" type="capsule" size="0.02" fromto="0 0 0 -0.1 0 0" mass="0.3"/>
  <body pos="-0.1 0 0"><joint axis="0 0.2 1" limited="false" damping="0"/>
   <geom name="tip" type="box" size="0.03 0.02 0.01" pos="-0.04 0 0" mass="0.2"/></body></body>
 <body pos="0.05 -0.1 -0.02"><joint name="leg1" axis="1 0 0"/>
  <geom name="ghost" size="0.2" conaffinity="4" condim="6" margin="0.1" mass="0.3"/>
  <body pos="0 -0.02 -0.03"><joint name="leg2" axis="0 1 0.1"/>
   <geom name="thigh" type="capsule" size="0.02" fromto="0 0 0 0.02 0 -0.12" mass="0.4"/>
   <body name="ankle" pos="0.02 0 -0.12" euler="0.2 0 0.1">
    <body pos="0 0 -0.02"><joint name="leg3" axis="0 1 0"/><geom name="shin" size="0.02" mass="0.2"/>
     <body name="foot" pos="0 0 -0.08" euler="0 0.1 0.2">
      <geom name="foot" type="cylinder" size="0.04 0.01" mass="0.1"/></body>
 </body></body></body></body>{legs}</body></worldbody><actuator>
 <motor joint="leg2" ctrllimited="false"/><motor joint="wheel" forcerange="-3 2"/><motor joint="leg3"/>
 <motor joint="leg1" gear="2"/></actuator></mujoco>"""
CRAB_LEG = """<body pos="{x} 0.1 0" euler="0 0 {x}"><joint axis="0.2 -1 0" pos="0.01 0 0"/>
<geom name="leg{x}" type="capsule" size="0.015 0.05" pos="0.08 0 -0.05" mass="0.2"/></body>"""


def make_a1(edit=None):
    """The specification of the A1, changed by a function."""
    spec = read_spec(RESOURCES_DIR / "robots/a1/a1.xml")
    if edit is not None:
        edit(spec)
    return spec


def make_walker():
    """Two legs with four joints each, off their bodies' origins and about odd axes; one joint has no motor."""
    legs = "".join(WALKER_LEG.format(s=side, y=y) for side, y in (("L", 0.08), ("R", -0.08)))
    motors = "".join(f'<motor joint="{joint}" gear="1.5"/>' for joint in ("R2", "R1", "L4", "L1", "L2", "R4", "L3"))
    return mujoco.MjSpec.from_string(WALKER.format(legs=legs, motors=motors))


def make_crab():
    """Five branches of one, two and three joints, some without motors or ranges; cylinders and fixed bodies on both.

    Its settings differ from those of the fused step, but change no motion, and one geom passes through the floor.
    """
    return mujoco.MjSpec.from_string(CRAB.format(legs="".join(CRAB_LEG.format(x=x) for x in (-0.1, 0.0))))


ROBOTS = {"a1": make_a1, "walker": make_walker, "crab": make_crab}


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


SELF_SCRATCH = {"poses", "found", "residual", "pushing", "change", "geoms", "normal", "jacobian", "joints", "matrix"}


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


def step_fused(model, states, iterations=100, ls_iterations=50, height_map=None):
    """The same after one fused step."""
    sim = make_engine("fused", model, len(states["qpos"]), "cpu", iterations, ls_iterations, height_map)
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
