"""Compare a physics step with a converged mj_step: ``python tools/accuracy.py --task=a1_position``.

States of ten kinds are made from those of a robot that walks under a trained policy. On rough ground, states of five
kinds are compared in which only feet are near the ground, which is a plane near each: plain MuJoCo has such a plane for
each foot.
"""

import copy
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

from legged_torque.utils.devices import disable_renderer

disable_renderer()  # before anything imports mujoco
from typing import Any

import mujoco
import numpy as np
import torch

from legged_torque import resource_path
from legged_torque.envs import task_registry
from legged_torque.envs.base.asset import load_asset
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.sim.engine import Engine, HeightMap
from legged_torque.sim.model import FLOOR, build_model
from legged_torque.sim.registry import ENGINES, make_engine
from legged_torque.sim.warp_engine import WarpEngine
from legged_torque.utils import cli
from legged_torque.utils.devices import device_name
from legged_torque.utils.limits import Count
from legged_torque.utils.mjcf import read_spec
from legged_torque.utils.options import Options
from legged_torque.utils.task_registry import LoadedRun, set_seed

WALKERS = 32  # worlds that walk
TOLERANCE = 1e-3  # a world with a velocity that is further off [m/s, rad/s] counts as wrong
LARGEST_TORQUE = 1000.0  # [N m]
_FAR = 100.0  # [m] from the floor, at most
_LEVEL = 1e-5  # [m] by which ground that is a plane may differ from it
_AT_FIRST = {"pos": [0.1, 0.2, 0.3], "quat": [1.0, 0.1, 0.2, 0.3]}  # poses that MuJoCo takes for simple are final

Arrays = dict[str, np.ndarray]
PhysicsState = dict[str, torch.Tensor]
"""A batch of states: "qpos", "qvel", "qacc_warmstart", "ctrl", each (worlds, size)."""
Pose = Callable[[mujoco.MjModel, mujoco.MjData], bool]
"""Poses a model for a state, and returns whether it is comparable then, as :meth:`PlanePerFoot.pose`."""


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
"""Changes of walking states, by name."""
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


def measure_accuracy(sim: WarpEngine, state: PhysicsState, expected: np.ndarray, comparable: np.ndarray) -> Accuracy:
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


class PlanePerFoot:
    """A robot whose spherical feet touch nothing but a plane each, posed like the ground under it.

    MuJoCo's own contacts with an ``hfield`` are no truth: sides of its prisms act as edges that are not there.

    Attributes:
        model: The model; :meth:`pose` changes it.
    """

    def __init__(self, spec: mujoco.MjSpec, feet: list[str], height_map: HeightMap) -> None:
        """Compile a robot that stands on a plane, from its specification, which changes."""
        floor, self._map, self._feet = spec.geom(FLOOR), height_map, feet
        names = ("friction", "solref", "solimp", "solmix", "priority", "condim")
        contact = {name: getattr(floor, name) for name in names}
        for k, foot in enumerate(feet):
            spec.geom(foot).contype, spec.geom(foot).conaffinity = 0, 2 << k
            kind = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0.0, 0.0, 1.0], "contype": 2 << k, "conaffinity": 0}
            spec.worldbody.add_geom(name=f"under_{foot}", **kind, **_AT_FIRST, **contact)
        floor.contype, floor.conaffinity = 2 << len(feet), 0  # which nothing touches
        self.model = build_model(spec, [])

    def pose(self, model: mujoco.MjModel, data: mujoco.MjData) -> bool:
        """Pose the planes of :attr:`model`, or a copy, for a state.

        Returns whether nothing else matters: the ground is lower than all other parts, and near each foot it is a
        plane or lower, too.
        """
        mujoco.mj_kinematics(model, data)
        is_exact = True
        for geom in range(model.ngeom):
            if not model.geom_bodyid[geom] or not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
                continue
            name = model.geom(geom).name
            for point, radius in _ends(model, data, geom):
                places, heights = self._near(point, radius)
                is_near = heights.max() >= point[2] - radius
                if name in self._feet:
                    slopes, height = self._triangle(point)
                    plane = model.geom(f"under_{name}").id
                    model.geom_pos[plane], model.geom_quat[plane] = [*point[:2], height], _upwards(slopes)
                    is_near &= np.abs(height + (places - point[:2]) @ slopes - heights).max() > _LEVEL
                is_exact &= not is_near
        return bool(is_exact)

    def _near(self, point: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return x, y and heights of the corners of all cells that are so near along x or y."""
        scale, corner, shape = self._map.horizontal_scale, self._map.corner, self._map.heights.shape
        first, last = (np.floor((point[:2] + side * radius - corner) / scale).astype(int) for side in (-1, 1))
        index = np.stack(np.meshgrid(*map(np.arange, first, last + 2), indexing="ij"), axis=-1).reshape(-1, 2)
        return corner + scale * index, self._map.heights[tuple(index.clip(0, np.array(shape) - 1).T)].astype(float)

    def _triangle(self, point: np.ndarray) -> tuple[np.ndarray, float]:
        """Return slopes along x and y, and height, of the triangle under a point; see :class:`HeightMap`."""
        places, (low, left, ahead, far) = self._near(point, 0.0)  # by columns first
        x, y = along = (point[:2] - places[0]) / self._map.horizontal_scale
        rises = np.array([ahead - low, far - ahead] if x >= y else [far - left, left - low])
        return rises / self._map.horizontal_scale, low + rises @ along


def _ends(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> list[tuple[np.ndarray, float]]:
    """Return the points of a geom that can touch the ground first, and how thick it is around them [m]."""
    centre, turn, size = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        return [(centre + turn @ (size * signs), 0.0) for signs in itertools.product((-1, 1), repeat=3)]
    half = size[1] if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
    return [(centre + side * half * turn[:, 2], size[0]) for side in (-1, 1)]


def _upwards(slopes: np.ndarray) -> np.ndarray:
    """Return the quaternion (w, x, y, z) that turns z to the normal of a plane with some slopes."""
    normal = np.array([*-slopes, 1.0]) / np.sqrt(1.0 + slopes @ slopes)
    quat = np.array([1.0 + normal[2], -normal[1], normal[0], 0.0])
    return quat / np.linalg.norm(quat)


def walk(run: LoadedRun, options: Options, steps: int) -> tuple[LeggedRobot, PhysicsState]:
    """Let a trained policy walk for some control steps; return its task, and the states after each."""
    env, runner = task_registry.make_loaded(run, options)
    policy, obs = runner.get_inference_policy(env.device), env.get_observations()
    kept: list[PhysicsState] = []
    with torch.inference_mode():
        for _ in range(steps):
            obs = env.step(policy(obs))[0]
            kept.append(copy_state(env.sim))
    return env, {name: torch.cat([state[name] for state in kept]) for name in kept[0]}


def main() -> None:
    """Let a trained policy walk, keep its states, make the others of them, and step each with both engines."""
    parser = cli.Parser(__doc__)
    cli.add_task_args(parser)
    parser.set_defaults(num_envs=WALKERS, seed=1)
    parser.add_argument("--steps", type=int, default=100, help="control steps to walk; the states after each are kept")
    parser.add_argument("--worlds", type=int, default=1500, help="states of each kind; default: %(default)s")
    args = parser.parse_args()
    cli.check_args(args, steps=Count, worlds=Count)
    options = cli.options_of(args)
    run = task_registry.load_run(options)
    set_seed(args.seed)
    env, walking_states = walk(run, options, args.steps)
    limits, ground, pose = (env.cfg.sim.solver_iterations, env.cfg.sim.ls_iterations), env.terrain.map, None
    sims: dict[str, Any] = {}
    for name, engine in ENGINES.items():
        height_map = ground if "height_map" in engine.capabilities else None
        model = open_motors(load_asset(env.cfg, None if height_map else env.terrain).mj_model)
        sims[name] = make_engine(name, model, args.worlds, env.device, *limits, height_map)
    if ground:
        spec = read_spec(resource_path(env.cfg.asset.file), env.dof_names)
        planes = PlanePerFoot(spec, env.foot_names, ground)
        model, pose = open_motors(planes.model), planes.pose
        model.opt.timestep = env.cfg.sim.dt
    print(f"{run.task} on {device_name(env.device)}: errors of the velocities after one step [m/s, rad/s]")
    print(f"of {args.worlds} worlds each; {limits[0]} iterations of the solver, {limits[1]} of its line search")
    titles = ("kind", "engine", "median", "99.9%", "max", f"> {TOLERANCE:g}", "left out", "iterations")
    print("{:<21} | {:<11} | {:>7} | {:>7} | {:>7} | {:>7} | {:>8} | {:>10}".format(*titles))
    for kind in ON_ANY_GROUND if ground else KINDS:
        states = make_states(kind, model, walking_states, args.worlds, args.seed)
        expected = reference_step(model, states, pose)
        for name, sim in sims.items():
            row = measure_accuracy(sim, states, *expected)
            errors = " | ".join(f"{value:7.1e}" for value in (row.median, row.p999, row.max))
            shares = f"{row.wrong:7.2%} | {row.left_out:8.2%} | {row.iterations:10.1f}"
            print(f"{kind:<21} | {name:<11} | {errors} | {shares}", flush=True)


if __name__ == "__main__":
    cli.run_script(main)
