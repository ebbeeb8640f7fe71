"""The structure of a robot, and the reasons why the fused step cannot simulate it."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from legged_torque.sim.fused.surface import FAR, NEAR
from legged_torque.utils.errors import refuse
from legged_torque.utils.mjcf import body_chains, colliding_pairs, self_pairs, why_no_motor

MAX_BRANCHES = 16  # threads of a world must fit into half a warp
_SELF_KINDS = [mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX]
_CAPSULE_ENDS = [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
_LOWEST_ON_CIRCLES = [(1.0, 0.0, 1.0), (1.0, 0.0, -1.0), (-0.5, 0.75**0.5, 1.0), (-0.5, -(0.75**0.5), 1.0)]
_AROUND_CIRCLES = [
    (math.cos(angle), math.sin(angle), z) for z in (-1.0, 1.0) for angle in (math.pi / 4 * i for i in range(8))
]
_BOX_CORNERS = [(float(x), float(y), float(z)) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
_GEOM_POINTS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: ([(0.0, 0.0, 0.0)], 1.0),
    mujoco.mjtGeom.mjGEOM_CAPSULE: (_CAPSULE_ENDS, 1.0),
    mujoco.mjtGeom.mjGEOM_CYLINDER: (_LOWEST_ON_CIRCLES, 0.0),
    mujoco.mjtGeom.mjGEOM_BOX: (_BOX_CORNERS, 0.0),
}
"""Points where a geom can touch the ground, in units of its half sizes, and the radius around them in first sizes.

The points of a cylinder are in a frame that is turned about its axis, see :func:`~.collision.turn_cylinder`: the lowest
points of both end circles, and two more of the lower circle, which make a triangle. On a height map such points could
turn into walls: there, points all around the end circles turn with the cylinder.
"""

Place = tuple[float, float, float]
"""A position, or half sizes, in half sizes of a geom."""
MIN_PARTS = 4
"""Parts of a box that is not small, at least: enough to lie on."""
MOST_PARTS = 4
"""Parts of a capsule, at most."""

SLOWER = "in training about 8 times slower"  # on an H200, see docs/performance.md
REFUSED = "sim.engine 'fused' cannot simulate this robot"
ADVICE = f"use sim.engine = 'mujoco_warp', {SLOWER}, without randomize_parameters"
FLOORS = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
"""Types of floors. The fused step has planes; its height maps are no geoms of the model."""


@dataclass
class Tree:
    """A robot's structure: a floating trunk and branches of hinge joints.

    ``points`` are, per branch, those that can touch the floor: geom, depth of its body (0 is the trunk), position in
    half sizes of the geom, radius in first sizes of the geom, numbers of the geom's first part and of the next geom's
    first point, half sizes of the part in half sizes of the geom. Parts are points that only a height map touches.
    """

    joints: np.ndarray  # joint of each place, -1 behind the end of a branch. Shape: (branches, most joints of one)
    points: list[list[tuple[int, int, Place, float, int, int, Place]]]
    has_cylinders: bool  # whether any of these geoms is one
    floor: int  # the geom that the robot stands on
    geom_places: list[tuple[int, int]]  # branch and depth of each geom's body; 0 and 0 of the trunk's and the world's

    @property
    def most_points(self) -> int:
        """Most points of a branch, at least one."""
        return max(1, *(len(points) for points in self.points))


def read_tree(model: mujoco.MjModel, floors: Sequence[mujoco.mjtGeom] = FLOORS[:1], on_map: bool = False) -> Tree:
    """Return the structure of a robot on a floor of one of some types, with points for a height map if ``on_map``.

    A UserError lists everything that the fused step does not simulate.
    """
    refuse(reasons_against(model, floors), REFUSED, ADVICE)
    floor = int(_floors(model, FLOORS)[0])
    posed = model.geom_pos[floor].any() or not np.array_equal(model.geom_quat[floor], (1.0, 0.0, 0.0, 0.0))
    wrong = ["its floor is not at the origin, where a height map needs it"] if on_map and posed else []
    refuse(wrong, REFUSED, ADVICE)
    chains = body_chains(model)
    joints = np.full((len(chains), max(map(len, chains))), -1)
    for i, chain in enumerate(chains):
        joints[i, : len(chain)] = model.body_jntadr[chain]
    depths = {body: (i, j + 1) for i, chain in enumerate(chains) for j, body in enumerate(chain)}
    places = [depths.get(body, (0, 0)) for body in model.geom_bodyid.tolist()]
    points: list[list] = [[] for _ in chains]
    geoms = np.flatnonzero(_touching(model, floor)).tolist()
    trunk_branches = itertools.cycle(range(len(chains)))  # geoms of the trunk are spread over the branches
    for geom in geoms:
        branch, depth = places[geom]
        of_branch = points[branch if depth else next(trunk_branches)]
        offsets, radius = _GEOM_POINTS[mujoco.mjtGeom(model.geom_type[geom])]
        if on_map and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER:
            offsets = _AROUND_CIRCLES
        pieces = [(offset, (0.0, 0.0, 0.0)) for offset in offsets]
        parts = len(of_branch) + len(pieces)
        if on_map:
            pieces += _parts(mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom], depth == 0)
        end = len(of_branch) + len(pieces)
        of_branch += [(geom, depth, offset, radius, parts, end, half) for offset, half in pieces]
    return Tree(joints, points, mujoco.mjtGeom.mjGEOM_CYLINDER in model.geom_type[geoms], floor, places)


def _parts(kind: mujoco.mjtGeom, size: np.ndarray, of_trunk: bool) -> list[tuple[Place, Place]]:
    """Return middles and half sizes of the parts of a geom that a height map can stick into between its points.

    A box is halved across its longest side until its parts are small and enough, a capsule of the trunk until they are
    small. Capsules of legs have none: these would take a fifth of a physics step.
    """
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE and of_trunk:
        count = next((count for count in range(1, MOST_PARTS) if size[0] + size[1] / count <= NEAR), MOST_PARTS)
        return [((0.0, 0.0, (2 * i + 1) / count - 1.0), (0.0, 0.0, 1.0 / count)) for i in range(count)]
    if kind != mujoco.mjtGeom.mjGEOM_BOX:
        return []
    counts = np.ones(3, int)
    while (radius := np.linalg.norm(size / counts)) > FAR or (radius > NEAR and counts.prod() < MIN_PARTS):
        counts[np.argmax(size / counts)] *= 2
    return [(tuple((2 * np.array(at) + 1) / counts - 1.0), tuple(1.0 / counts)) for at in np.ndindex(*counts)]


def reasons_against(model: mujoco.MjModel, floors: Sequence[mujoco.mjtGeom] = FLOORS) -> list[str]:
    """Return the reasons why the fused step cannot simulate a robot on a floor of one of some types."""
    rules = _of_bodies(model) | _of_contacts(model, floors) | _of_motors(model) | _of_options(model)
    reasons = [reason for reason, holds in rules.items() if not holds]
    chains = body_chains(model)
    branching = np.flatnonzero(np.bincount(model.body_parentid[2:]) > 1)
    reasons += [f"body '{model.body(body).name}' branches" for body in branching if body > 1]
    if not 0 < len(chains) <= MAX_BRANCHES:
        reasons.append(f"it has {len(chains)} legs, not 1 to {MAX_BRANCHES}")
    return reasons


def _of(part: Any, chosen: np.ndarray) -> str:
    """Return the names of the chosen bodies or geoms of a model, or the first three of many."""
    names = [f"'{part(i).name}'" for i in np.flatnonzero(chosen)]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


_HARMLESS_DISABLED = ("contact", "midphase", "nativeccd", "multiccd", "island", "autoreset", "warmstart", "equality")
_HARMLESS_ENABLED = ("energy", "fwdinv", "invdiscrete", "multiccd")
"""Flags that change no motion of a robot without equalities and convex collisions; a minimum has no warm start.

Without contacts, no geoms meet."""
_INTEGRATORS = (mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtIntegrator.mjINT_EULER)
"""Both are the same if linear damping of joints is the only force that depends on velocities."""


def _names(flags: Any, values: int, harmless: Sequence[str]) -> list[str]:
    """Return the names of some of MuJoCo's flags, as a MJCF has them, but for harmless ones."""
    found = [name[7:].lower() for name, flag in flags.__members__.items() if name[6] == "_" and int(flag) & values]
    return [name for name in found if name not in harmless]


def _of_options(model: mujoco.MjModel) -> dict[str, bool]:
    """Return whether options and other parts of the model are simulated, by what is said if not."""
    option = model.opt
    disabled = _names(mujoco.mjtDisableBit, option.disableflags, _HARMLESS_DISABLED)
    if option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        disabled = [flag for flag in disabled if flag != "eulerdamp"]
    enabled = _names(mujoco.mjtEnableBit, option.enableflags, _HARMLESS_ENABLED)
    others = model.eq_active0.any() or model.ntendon or model.nmocap
    return {
        "the friction cone must be pyramidal": option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "the integrator must be implicitfast or Euler": option.integrator in _INTEGRATORS,
        f"it disables {', '.join(disabled)}": not disabled,
        f"it enables {', '.join(enabled)}": not enabled,
        "it disables groups of actuators": not option.disableactuator,
        "it has noslip iterations": not option.noslip_iterations,
        "it moves through a fluid": not (option.density or option.viscosity),
        "equalities, tendons or mocap": not others,
        "a <pair> with the ground, or other than condim 3, one friction and no margin": _plain_pairs(model),
        "some contacts are excluded": not any(0 in divmod(pair, 1 << 16) for pair in model.exclude_signature),
    }


def _plain_pairs(model: mujoco.MjModel) -> bool:
    """Return whether each <pair> is of two parts of the robot, with parameters that contacts of geoms can have."""
    grounded = (model.geom_bodyid[[model.pair_geom1, model.pair_geom2]] == 0).any()
    odd = _any_of(model, "pair_margin", "pair_gap", "pair_solreffriction", "pair_adhesion") or grounded
    same = (model.pair_friction[:, 0] == model.pair_friction[:, 1]).all()
    return not odd and bool(same and (model.pair_dim == 3).all() and not _mixed(model.pair_solref).any())


def _mixed(solrefs: np.ndarray) -> np.ndarray:
    """Return which solrefs mix their two formats. Shapes: (n, 2), (n,)."""
    return ~((solrefs > 0).all(axis=1) | (solrefs <= 0).all(axis=1))


def _of_bodies(model: mujoco.MjModel) -> dict[str, bool]:
    """Return whether bodies and joints are simulated."""
    hinge, free = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE
    is_free = model.njnt > 0 and model.jnt_type[0] == free and model.jnt_bodyid[0] == 1
    has_hinge = (model.body_jntnum == 1) & (np.append(model.jnt_type, -1)[model.body_jntadr] == hinge)
    odd = ~has_hinge & (np.arange(model.nbody) > 1)
    root = [model.dof_damping[:6], model.dof_armature[:6], model.dof_frictionloss[:6], model.jnt_stiffness[:1]]
    passive = is_free and any(values.any() for values in root)
    nonlinear = _any_of(model, "jnt_stiffnesspoly", "jnt_springyield", "dof_dampingpoly")
    return {
        "its trunk is not free": is_free,
        f"each body but the trunk must have one hinge joint, unlike {_of(model.body, odd)}": not odd.any(),
        "something besides the trunk hangs on the world": not (model.body_parentid[2:] == 0).any(),
        "bodies are compensated for gravity": not model.body_gravcomp.any(),
        "joint limits have margins": not model.jnt_margin.any(),
        "joints limit the forces of their actuators": not model.jnt_actfrclimited.any(),
        "the trunk's free joint has passive forces or armature": not passive,
        "springs or dampers are not linear": not nonlinear,
    }


def _of_contacts(model: mujoco.MjModel, floors: Sequence[mujoco.mjtGeom]) -> dict[str, bool]:
    """Return whether the floor and colliding geoms are simulated."""
    collides = _collides(model)
    floor = _floors(model, floors)
    robot = collides & (model.geom_bodyid > 0)
    own = self_pairs(model)
    alone = len(floor) == 1 and (collides & ~robot).sum() == 1
    touching = _touching(model, floor[0]) if alone else robot
    on_floor = np.stack(np.broadcast_arrays(floor[:1], np.flatnonzero(touching)), axis=1) if alone else own
    geoms = np.unique(np.concatenate([own.ravel(), on_floor.ravel(), floor]))
    odd = touching & ~np.isin(model.geom_type, list(_GEOM_POINTS))
    odd_own = np.isin(np.arange(model.ngeom), own) & ~np.isin(model.geom_type, _SELF_KINDS)
    solrefs = np.concatenate([model.geom_solref[geoms], model.jnt_solref, model.dof_solref])
    unlike, own_unlike = _of(model.geom, odd), _of(model.geom, odd_own)
    return {
        "it needs one plane and no other obstacle": alone,
        f"only spheres, capsules, cylinders and boxes may collide, unlike {unlike}": not odd.any(),
        f"only spheres, capsules and boxes may collide with each other, unlike {own_unlike}": not odd_own.any(),
        "condim of contacts with the floor must be 3": bool((_condims(model, on_floor) == 3).all()),
        "condim of contacts between its parts must be 3": bool((_condims(model, own) == 3).all()),
        "geoms have margins or gaps": not (model.geom_margin[geoms].any() or model.geom_gap[geoms].any()),
        "surfaces move or stick": not _any_of(model, "geom_surfacevel", "geom_adhesion"),
        "a solref mixes its two formats": not _mixed(solrefs).any(),
    }


def _collides(model: mujoco.MjModel) -> np.ndarray:
    """Return which geoms can collide with anything. Shape: (ngeom,), bool."""
    return (model.geom_contype | model.geom_conaffinity) != 0


def _floors(model: mujoco.MjModel, types: Sequence[mujoco.mjtGeom]) -> np.ndarray:
    """Return the geoms of some types of floors that can collide. Shape: (floors,)."""
    return np.flatnonzero(np.isin(model.geom_type, types) & _collides(model))


def _touching(model: mujoco.MjModel, floor: int) -> np.ndarray:
    """Return which geoms of the robot can touch the floor. Shape: (ngeom,), bool."""
    pairs = colliding_pairs(model)
    return np.isin(np.arange(model.ngeom), pairs[(pairs == floor).any(axis=1)]) & (model.geom_bodyid > 0)


def _condims(model: mujoco.MjModel, pairs: np.ndarray) -> np.ndarray:
    """Return the dimension of contacts of pairs of geoms: that of higher priority, else the higher one. Shape: (n,)."""
    priority, condim = model.geom_priority[pairs], model.geom_condim[pairs]
    return np.where(priority == priority.max(axis=1, keepdims=True), condim, 0).max(axis=1)


def _of_motors(model: mujoco.MjModel) -> dict[str, bool]:
    """Return whether actuators are simulated: at most a plain motor per hinge."""
    plain = not any(why_no_motor(model, actuator) for actuator in range(model.nu))
    joints = model.actuator_trnid[:, 0]
    return {
        "actuators must be motors": plain and bool((model.actuator_gainprm[:, 0] == 1).all()),
        "each motor needs a hinge of its own": len(set(joints)) == len(joints) and 0 not in joints,
    }


def _any_of(model: mujoco.MjModel, *names: str) -> bool:
    """Return whether a field is not all zero; older versions of MuJoCo lack some fields."""
    return any(getattr(model, name, np.zeros(0)).any() for name in names)
