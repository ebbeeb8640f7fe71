"""How far a physics step is from MuJoCo's own, converged in float64, in states from walking to wild ones."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from legged_torque.sim.engine import Engine

TOLERANCE = 1e-3  # a world with a velocity that is further off [m/s, rad/s] counts as wrong
LARGEST_TORQUE = 1000.0  # [N m]
_FAR = 100.0  # [m] from the floor, at most

Arrays = dict[str, np.ndarray]
PhysicsState = dict[str, torch.Tensor]
"""A batch of states: "qpos", "qvel", "qacc_warmstart", "ctrl", each (worlds, size)."""
Pose = Callable[[mujoco.MjModel, mujoco.MjData], bool]
"""Makes a model fit a state, and says whether it does, as :meth:`~tools.planes.PlanePerFoot.pose`."""


def copy_state(sim: Engine) -> PhysicsState:
    """Return a copy of the arrays that the next physics step depends on."""
    return {name: getattr(sim, name).clone() for name in ("qpos", "qvel", "qacc_warmstart", "ctrl")}


def open_motors(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a model whose motors give torques up to :data:`LARGEST_TORQUE`."""
    model = copy.copy(model)
    model.actuator_ctrlrange[:] = model.actuator_forcerange[:] = (-LARGEST_TORQUE, LARGEST_TORQUE)
    return model


def directions(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Return random unit vectors. Shape: (count, size)."""
    vectors = rng.normal(size=(count, size))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def put_on_floor(model: mujoco.MjModel, state: Arrays, depths: np.ndarray) -> None:
    """Move trunks up or down until the lowest part of each robot is as deep in the floor [m] as asked for."""
    data, floor = mujoco.MjData(model), model.geom("floor").id
    parts = [i for i in range(model.ngeom) if i != floor and (model.geom_contype[i] or model.geom_conaffinity[i])]
    for qpos, depth in zip(state["qpos"], depths, strict=True):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        lowest = min(mujoco.mj_geomDistance(model, data, floor, part, _FAR, None) for part in parts)
        qpos[2] -= lowest + depth


def walking(model: mujoco.MjModel, state: Arrays, rng: np.random.Generator) -> None:
    """Leave the states as they are."""


def sliding(model: mujoco.MjModel, state: Arrays, rng: np.random.Generator) -> None:
    """Let the trunks move sideways at 1 to 3 m/s."""
    count = len(state["qvel"])
    state["qvel"][:, :2] = directions(rng, count, 2) * rng.uniform(1.0, 3.0, (count, 1))


def fast_joints(model: mujoco.MjModel, state: Arrays, rng: np.random.Generator) -> None:
    """Draw joint velocities up to 30 rad/s."""
    state["qvel"][:, 6:] = rng.uniform(-30.0, 30.0, state["qvel"][:, 6:].shape)


def impact(model: mujoco.MjModel, state: Arrays, rng: np.random.Generator) -> None:
    """Let the trunks fall at 1 to 6 m/s."""
    state["qvel"][:, 2] = -rng.uniform(1.0, 6.0, len(state["qvel"]))


def straight_legs(model: mujoco.MjModel, state: Arrays, rng: np.random.Generator) -> None:
    """Stretch the last joint of each leg to within 0.02 rad of the end of its range that is nearest to 0."""
    last = np.setdiff1d(np.arange(1, model.nbody), model.body_parentid)  # bodies without children
    joints = model.body_jntadr[last]
    ranges = model.jnt_range[joints]
    ends = np.take_along_axis(ranges, np.abs(ranges).argmin(axis=1)[:, None], axis=1)[:, 0]
    inside = rng.uniform(0.0, 0.02, (len(state["qpos"]), len(joints)))
    state["qpos"][:, model.jnt_qposadr[joints]] = ends + inside * np.sign(ranges.mean(axis=1) - ends)
    put_on_floor(model, state, rng.uniform(0.0, 0.005, len(state["qpos"])))


def tumbling(model: mujoco.MjModel, state: Arrays, rng: np.random.Generator) -> None:
    """Turn the trunks at 20 rad/s about any axis, in any orientation, on the floor."""
    count = len(state["qpos"])
    state["qpos"][:, 3:7] = directions(rng, count, 4)
    state["qvel"][:, 3:6] = 20.0 * directions(rng, count, 3)
    put_on_floor(model, state, rng.uniform(0.0, 0.01, count))


def deep(model: mujoco.MjModel, state: Arrays, rng: np.random.Generator) -> None:
    """Press the robots up to 5 cm into the floor."""
    put_on_floor(model, state, rng.uniform(0.0, 0.05, len(state["qpos"])))


def upside_down(model: mujoco.MjModel, state: Arrays, rng: np.random.Generator) -> None:
    """Lay the robots on their backs, tilted by about 0.2 rad."""
    count = len(state["qpos"])
    quat = np.array([0.0, 1.0, 0.0, 0.0]) + rng.normal(0.0, 0.1, (count, 4))
    state["qpos"][:, 3:7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    put_on_floor(model, state, rng.uniform(0.0, 0.01, count))


def large_torques(model: mujoco.MjModel, state: Arrays, rng: np.random.Generator) -> None:
    """Draw torques up to :data:`LARGEST_TORQUE`."""
    state["ctrl"][:] = rng.uniform(-LARGEST_TORQUE, LARGEST_TORQUE, state["ctrl"].shape)


def flight(model: mujoco.MjModel, state: Arrays, rng: np.random.Generator) -> None:
    """Throw the robots into the air, every joint within 0.05 rad of one of its limits, inside or beyond."""
    state["qpos"][:, 2] = 2.0
    low, high = model.jnt_range[1:].T
    shape = state["qpos"][:, 7:].shape
    ends = np.where(rng.random(shape) < 0.5, low, high)
    state["qpos"][:, 7:] = ends + rng.uniform(-0.05, 0.05, shape)


KINDS: dict[str, Callable[[mujoco.MjModel, Arrays, np.random.Generator], None]] = {
    "walking": walking,
    "sliding at 1 to 3 m/s": sliding,
    "joints to 30 rad/s": fast_joints,
    "impact at 1 to 6 m/s": impact,
    "straight legs": straight_legs,
    "tumbling at 20 rad/s": tumbling,
    "up to 5 cm deep": deep,
    "upside down": upside_down,
    "torques to 1000 N m": large_torques,
    "flight, at the limits": flight,
}
"""What is changed in walking states, by name."""
ON_ANY_GROUND = [
    name for name, change in KINDS.items() if change in (walking, sliding, fast_joints, impact, large_torques)
]
"""Those that do not need a level floor."""


def make_states(kind: str, model: mujoco.MjModel, walking_states: PhysicsState, count: int, seed: int) -> PhysicsState:
    """Return random states of one of :data:`KINDS`, made from walking ones of a model on a level floor at z = 0."""
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(walking_states["qpos"]), count)
    state = {name: values.double().cpu().numpy()[chosen] for name, values in walking_states.items()}
    KINDS[kind](model, state, rng)
    return {name: torch.tensor(values, dtype=torch.float32) for name, values in state.items()}


def reference_step(
    model: mujoco.MjModel, state: PhysicsState, pose: Pose | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Take one converged ``mj_step`` in float64 per state, for which the model may be posed.

    Returns:
        The velocities (worlds, nv), and which worlds are comparable (worlds,), bool. Those are not in which a contact
        only just touches: raising or lowering the trunk by half of float32's spacing at its height changes the number
        of contacts. There ``mj_step`` jumps, since a contact acts with all its damping as soon as it touches. Nor are
        those that cannot be posed.
    """
    model = copy.copy(model)
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    data, arrays = mujoco.MjData(model), {name: tensor.double().cpu().numpy() for name, tensor in state.items()}
    velocities, comparable = np.zeros((len(arrays["qpos"]), model.nv)), np.ones(len(arrays["qpos"]), dtype=bool)
    for world, height in enumerate(arrays["qpos"][:, 2].astype(np.float32)):
        for name, values in arrays.items():
            getattr(data, name)[:] = values[world]
        is_posed = pose is None or pose(model, data)
        contacts = []
        for change in (-0.5, 0.5, 0.0):
            data.qpos[2] = height + change * float(np.spacing(np.abs(height)))
            mujoco.mj_fwdPosition(model, data)
            contacts.append(data.ncon)
        mujoco.mj_step(model, data)
        velocities[world], comparable[world] = data.qvel, is_posed and len(set(contacts)) == 1
    return velocities, comparable


@dataclass
class Accuracy:
    """Errors of the velocities after one physics step [m/s, rad/s]."""

    median: float  # of all velocities of the comparable worlds, like the next three
    p999: float  # 99.9th percentile
    max: float
    rms: float
    wrong: float  # share of the comparable worlds with an error above TOLERANCE
    left_out: float  # share of the worlds that are not comparable
    iterations: float  # mean of the solver's


def measure_accuracy(sim: Engine, state: PhysicsState, expected: np.ndarray, comparable: np.ndarray) -> Accuracy:
    """Compare one step of a simulator with as many worlds with a :func:`reference_step`; not finite is wrong."""
    for name, values in state.items():
        getattr(sim, name).copy_(values)
    sim.step()
    error = np.abs(sim.qvel.double().cpu().numpy() - expected)[comparable]
    error[~np.isfinite(error)] = math.inf
    return Accuracy(
        median=float(np.median(error)),
        p999=float(np.quantile(error, 0.999, method="higher")),
        max=float(error.max()),
        rms=float(np.sqrt(np.mean(error**2))),
        wrong=float((error.max(axis=1) > TOLERANCE).mean()),
        left_out=float(1.0 - comparable.mean()),
        iterations=float(sim.solver_niter.float().mean()),
    )
