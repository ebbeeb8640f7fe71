"""The structure of a robot, if it is one that the fused step can simulate."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged_torque.utils.errors import UserError

MAX_BRANCHES = 16  # threads of a world must fit into half a warp
_CAPSULE_ENDS = [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
_BOX_CORNERS = [(float(x), float(y), float(z)) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
_GEOM_POINTS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: ([(0.0, 0.0, 0.0)], 1.0),
    mujoco.mjtGeom.mjGEOM_CAPSULE: (_CAPSULE_ENDS, 1.0),
    mujoco.mjtGeom.mjGEOM_BOX: (_BOX_CORNERS, 0.0),
}
"""Where a geom can touch the ground: points in units of its half sizes, and how many radii it is thick around them."""


FLOORS = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
"""What robots stand on; the fused step knows planes only, its height maps are none of the model's geoms."""


@dataclass
class Tree:
    """A robot's structure: a floating trunk and branches of hinge joints, each with ``depth`` joints.

    ``points`` are, per branch, those that can touch the floor: geom, depth of its body (0 is the trunk), position in
    half sizes of the geom, radius in first sizes of the geom.
    """

    joints: np.ndarray  # joint of each place. Shape: (branches, depth)
    points: list[list[tuple[int, int, tuple[float, float, float], float]]]

    @property
    def most_points(self) -> int:
        """Most points of a branch, at least one."""
        return max(1, *(len(points) for points in self.points))


def read_tree(model: mujoco.MjModel, floors: Sequence[mujoco.mjtGeom] = FLOORS[:1]) -> Tree:
    """Return the structure of a robot on a floor of one of some types.

    A UserError if it has something that the fused step does not simulate.
    """
    _check(model, floors)
    children = [[c for c in range(2, model.nbody) if model.body_parentid[c] == b] for b in range(model.nbody)]
    chains = []
    for body in children[1]:
        chain = [body]
        while children[chain[-1]]:
            _require(len(children[chain[-1]]) == 1, f"body '{model.body(chain[-1]).name}' branches")
            chain.append(children[chain[-1]][0])
        chains.append(chain)
    _require(bool(chains) and len({len(chain) for chain in chains}) == 1, "its legs have unlike numbers of joints")
    _require(len(chains) <= MAX_BRANCHES, f"it has more than {MAX_BRANCHES} legs")
    points: list[list] = [[] for _ in chains]
    depths = {body: (i, j + 1) for i, chain in enumerate(chains) for j, body in enumerate(chain)}
    trunk_geoms = 0
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] == 0 or not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        if model.geom_bodyid[geom] == 1:  # spread over the branches
            branch, depth = trunk_geoms % len(chains), 0
            trunk_geoms += 1
        else:
            branch, depth = depths[model.geom_bodyid[geom]]
        offsets, radius = _GEOM_POINTS[mujoco.mjtGeom(model.geom_type[geom])]
        points[branch] += [(geom, depth, offset, radius) for offset in offsets]
    return Tree(np.array([[model.body_jntadr[body] for body in chain] for chain in chains]), points)


def find_floor(model: mujoco.MjModel) -> int:
    """Return the geom that an accepted robot stands on."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return int(np.flatnonzero(np.isin(model.geom_type, FLOORS) & collides)[0])


def check_map(model: mujoco.MjModel) -> None:
    """Raise a UserError if the floor of an accepted robot cannot become a height map, whose heights are the world's."""
    floor = find_floor(model)
    posed = model.geom_pos[floor].any() or not np.array_equal(model.geom_quat[floor], (1.0, 0.0, 0.0, 0.0))
    _require(not posed, "its floor is not at the origin, where a height map needs it")


def _require(holds: bool, reason: str) -> None:
    """Raise a UserError with the reason if something does not hold."""
    if not holds:
        advice = "use sim.engine = 'mujoco_warp', without randomize_parameters"
        raise UserError(f"sim.engine 'fused' cannot simulate this robot: {reason}; {advice}")


def _check(model: mujoco.MjModel, floors: Sequence[mujoco.mjtGeom]) -> None:
    """Raise a UserError for whatever the fused step does not simulate."""
    _check_bodies(model)
    _check_contacts(model, floors)
    _check_motors(model)
    option = model.opt
    _require(option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL, "the friction cone must be pyramidal")
    _require(option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST, "the integrator must be implicitfast")
    enabled = option.enableflags & ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)  # which changes no motion
    flags = option.disableflags or enabled or option.noslip_iterations or option.disableactuator
    _require(not flags, "it sets flags in its options")
    _require(not (option.density or option.viscosity), "it moves through a fluid")
    others = model.eq_active0.any() or model.ntendon or model.npair or model.nmocap
    _require(not others, "equalities, tendons, pairs or mocap")
    _require(not (_excluded(model) == 0).any(), "some contacts are excluded")


def _check_bodies(model: mujoco.MjModel) -> None:
    """Check bodies and joints."""
    hinge, free = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE
    _require(model.nbody > 1 and model.jnt_type[0] == free and model.jnt_bodyid[0] == 1, "its trunk is not free")
    hinges = bool((model.body_jntnum[1:] == 1).all() and (model.jnt_type[1:] == hinge).all())
    _require(hinges, "each body but the trunk must have one hinge joint (fixed bodies: compiler fusestatic)")
    _require(not (model.body_parentid[2:] == 0).any(), "something beside the trunk hangs on the world")
    _require(not model.body_gravcomp.any(), "bodies are compensated for gravity")
    _require(bool(model.jnt_limited[1:].all()), "each joint needs a range")
    _require(not model.jnt_margin.any(), "joint limits have margins")
    _require(not (model.jnt_actfrclimited.any()), "joints limit the forces of their actuators")
    root = [model.dof_damping[:6], model.dof_armature[:6], model.dof_frictionloss[:6], model.jnt_stiffness[:1]]
    _require(not any(values.any() for values in root), "the trunk's free joint has passive forces or armature")
    nonlinear = _any_of(model, "jnt_stiffnesspoly", "jnt_springyield", "dof_dampingpoly")
    _require(not nonlinear, "springs or dampers are not linear")


def _check_contacts(model: mujoco.MjModel, floors: Sequence[mujoco.mjtGeom]) -> None:
    """Check the floor and what collides with it."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    floor = np.flatnonzero(np.isin(model.geom_type, floors) & collides)
    robot = collides & (model.geom_bodyid > 0)
    _require(bool(len(floor) == 1 and (collides & ~robot).sum() == 1), "it needs one plane and no other obstacle")
    types, affinities, bodies = model.geom_contype[robot], model.geom_conaffinity[robot], model.geom_bodyid[robot]
    kinds = {mujoco.mjtGeom(kind) for kind in model.geom_type[robot]}
    _require(kinds <= set(_GEOM_POINTS), "only spheres, capsules and boxes may collide")
    apart = _may_collide(model)[np.ix_(bodies, bodies)]
    _require(not (types[:, None] & affinities)[apart].any(), "parts of the robot collide with each other")
    touch = (types & model.geom_conaffinity[floor]) | (affinities & model.geom_contype[floor])
    _require(bool((touch != 0).all()), "the floor lets some of its geoms through")
    _require(bool((model.geom_condim[collides] == 3).all()), "condim must be 3")
    _require(not (model.geom_margin[collides].any() or model.geom_gap[collides].any()), "geoms have margins or gaps")
    _require(not _any_of(model, "geom_surfacevel", "geom_adhesion"), "surfaces move or stick")
    solrefs = np.concatenate([model.geom_solref[collides], model.jnt_solref, model.dof_solref])
    _require(bool(((solrefs > 0).all(axis=1) | (solrefs <= 0).all(axis=1)).all()), "a solref mixes its two formats")


def _excluded(model: mujoco.MjModel) -> np.ndarray:
    """Return pairs of bodies whose contacts are excluded. Shape: (pairs, 2)."""
    return np.stack([model.exclude_signature >> 16, model.exclude_signature & 0xFFFF], axis=1)


def _may_collide(model: mujoco.MjModel) -> np.ndarray:
    """Return which bodies can touch each other: not parent and child, not those excluded. Shape: (nbody, nbody)."""
    apart = ~np.eye(model.nbody, dtype=bool)
    children = np.arange(2, model.nbody)
    pairs = np.concatenate([np.stack([model.body_parentid[children], children], axis=1), _excluded(model)])
    apart[pairs[:, 0], pairs[:, 1]] = apart[pairs[:, 1], pairs[:, 0]] = False
    return apart


def _check_motors(model: mujoco.MjModel) -> None:
    """Check the actuators: at most one plain motor per hinge."""
    plain = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    plain &= model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED
    plain &= model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE
    plain &= model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE
    extras = _any_of(model, "actuator_delay", "actuator_damping", "actuator_dampingpoly", "actuator_armature")
    _require(bool((plain & (model.actuator_gainprm[:, 0] == 1)).all()) and not extras, "actuators must be motors")
    joints = model.actuator_trnid[:, 0]
    _require(len(set(joints)) == len(joints) and 0 not in joints, "each motor needs a hinge of its own")
    _require(bool(model.actuator_forcelimited.all() and model.actuator_ctrllimited.all()), "motors need ranges")


def _any_of(model: mujoco.MjModel, *names: str) -> bool:
    """Return whether a field is not all zero; older versions of MuJoCo lack some."""
    return any(getattr(model, name, np.zeros(0)).any() for name in names)
