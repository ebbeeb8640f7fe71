"""From a robot's MJCF file to the model that is simulated."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from legged_torque.utils.errors import unknown_name
from legged_torque.utils.mjcf import loading

CONTACT_DATA = 4  # numbers per contact sensor: number of contacts, then the net force (x, y, z) in the world frame [N]

FLOOR = "floor"  # name of the geom that robots stand on
_DATASPEC = sum(1 << int(f) for f in (mujoco.mjtConDataField.mjCONDATA_FOUND, mujoco.mjtConDataField.mjCONDATA_FORCE))
_REDUCE_NETFORCE = 3


def read_spec(file: Path) -> mujoco.MjSpec:
    """Read a MJCF file; a UserError if it is missing or cannot be read."""
    with loading(file):
        return mujoco.MjSpec.from_file(str(file))


def collision_geoms(spec: mujoco.MjSpec, floor: str = FLOOR) -> list[str]:
    """Return the names of the geoms that can touch the ground, in the file's order."""
    geoms = [geom.name for geom in spec.geoms if geom.name and (geom.contype or geom.conaffinity)]
    return [name for name in geoms if name != floor]


def indices_matching(names: list[str], parts: list[str]) -> list[int]:
    """Return which names contain one of ``parts``; a UserError if a part matches no name."""
    for part in parts:
        if not any(part in name for name in names):
            raise unknown_name("collision geom (part of its name)", part, names)
    return [i for i, name in enumerate(names) if any(part in name for part in parts)]


def build_model(spec: mujoco.MjSpec, contact_geoms: list[str]) -> mujoco.MjModel:
    """Compile the model to simulate: without what is only there to be seen, and with contact sensors.

    Bodies without joints become part of what they are fixed to, unless something refers to them. The contacts of each
    of ``contact_geoms``, with the floor or other parts of the robot, are sensed, by a sensor each, in this order. They
    are the only sensors of the model.
    """
    spec.compiler.discardvisual = spec.compiler.fusestatic = True
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for name in contact_geoms:
        spec.add_sensor(
            name=f"{name}_contact",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=name,  # the second geom, since the force is the one that the first exerts on it, whichever that is
            intprm=[_DATASPEC, _REDUCE_NETFORCE, 1],
        )
    return spec.compile()


def colliding_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Return the pairs of geoms that may touch, as MuJoCo filters them. Shape: (pairs, 2).

    They meet by ``contype`` and ``conaffinity`` and are neither of one body, nor of parent and child, nor of bodies
    that are excluded; or they are a ``<pair>``.
    """
    first, second = np.triu_indices(model.ngeom, k=1)
    bodies = model.geom_bodyid[[first, second]]
    welds = model.body_weldid[bodies]  # bodies without joints are parts of those that they hang on
    parents = model.body_weldid[model.body_parentid[welds]]
    family = (welds[0] == welds[1]) | ((welds > 0).all(axis=0) & (welds == parents[::-1]).any(axis=0))
    excluded = np.isin((bodies[0] << 16) + bodies[1], model.exclude_signature)
    types, affinities = model.geom_contype, model.geom_conaffinity
    meet = (types[first] & affinities[second]) | (types[second] & affinities[first])
    chosen = np.stack([first, second], axis=1)[(meet != 0) & ~family & ~excluded]
    named = np.sort(np.stack([model.pair_geom1, model.pair_geom2], axis=1), axis=1)
    return np.unique(np.concatenate([chosen, named]), axis=0)


def self_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Return those of :func:`colliding_pairs` whose geoms are both parts of the same robot. Shape: (pairs, 2)."""
    pairs = colliding_pairs(model)
    bodies = model.geom_bodyid[pairs]
    roots, moving = model.body_rootid[bodies], model.body_weldid[bodies] > 0
    return pairs[(roots[:, 0] == roots[:, 1]) & moving.all(axis=1)]


def exclude_self_collisions(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    """Let no parts of a robot collide with each other, whatever its file says.

    Returns whether anything has changed, so that ``model``, compiled from ``spec``, is out of date.
    """
    pairs = self_pairs(model)
    bodies = {body.id: body for body in spec.bodies}
    for first, second in np.unique(model.geom_bodyid[pairs], axis=0).tolist():
        for body in (first, second):
            bodies[body].name = bodies[body].name or f"body {body}"
        spec.add_exclude(bodyname1=bodies[first].name, bodyname2=bodies[second].name)
    unwanted = {frozenset(model.geom(geom).name for geom in pair) for pair in pairs.tolist()}
    for pair in list(spec.pairs):
        if {pair.geomname1, pair.geomname2} in unwanted:
            spec.delete(pair)
    return len(pairs) > 0


def use_known_options(model: mujoco.MjModel) -> None:
    """Replace the options that MuJoCo Warp refuses although they change no motion: flags and the solver's method."""
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE | mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_FWDINV)
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON  # which finds the same minimum


def max_contacts(model: mujoco.MjModel) -> int:
    """Return the most contacts that one world can have: one per sphere, two per capsule, eight per other geom.

    On a height field, every geom has four at most: those that MuJoCo Warp keeps.
    """
    on_hfield = int(mujoco.mjtGeom.mjGEOM_HFIELD)
    per_type = {int(mujoco.mjtGeom.mjGEOM_SPHERE): 1, int(mujoco.mjtGeom.mjGEOM_CAPSULE): 2}
    kinds = model.geom_type[colliding_pairs(model)].tolist()
    return sum(4 if on_hfield in pair else min(per_type.get(kind, 8) for kind in pair) for pair in kinds)


_EQUALITY_ROWS = {int(mujoco.mjtEq.mjEQ_CONNECT): 3, int(mujoco.mjtEq.mjEQ_WELD): 6}  # others have one


def max_constraints(model: mujoco.MjModel, contacts: int, any_friction: bool = False) -> int:
    """Return the most constraint rows that one world can have (pyramidal friction cones).

    With ``any_friction``, worlds may have dry friction in joints where the model has none.
    """
    rows_per_contact = 2 * (int(model.geom_condim.max()) - 1)
    friction = model.nv if any_friction else int((model.dof_frictionloss > 0).sum())
    friction += int((model.tendon_frictionloss > 0).sum())
    equalities = sum(_EQUALITY_ROWS.get(int(kind), 1) for kind in model.eq_type)
    return (
        contacts * rows_per_contact + friction + int(model.jnt_limited.sum() + model.tendon_limited.sum()) + equalities
    )
