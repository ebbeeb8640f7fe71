"""The simulated model of a robot's MJCF file, and the sizes of MuJoCo Warp's buffers for it."""

import mujoco

from legged_torque.utils.errors import unknown_name
from legged_torque.utils.mjcf import colliding_pairs

CONTACT_DATA = 4  # numbers per contact sensor: number of contacts, then the net force (x, y, z) in the world frame [N]

FLOOR = "floor"  # name of the geom that robots stand on
_DATASPEC = sum(1 << int(f) for f in (mujoco.mjtConDataField.mjCONDATA_FOUND, mujoco.mjtConDataField.mjCONDATA_FORCE))
_REDUCE_NETFORCE = 3


def collision_geoms(spec: mujoco.MjSpec) -> list[str]:
    """Return the names of the geoms that can touch the ground, in the file's order."""
    geoms = [geom.name for geom in spec.geoms if geom.name and (geom.contype or geom.conaffinity)]
    return [name for name in geoms if name != FLOOR]


def indices_matching(names: list[str], parts: list[str], kind: str = "collision geom") -> list[int]:
    """Return which names contain one of ``parts``; a UserError if a part matches no name of this kind."""
    for part in parts:
        if not any(part in name for name in names):
            raise unknown_name(f"{kind} (part of its name)", part, names)
    return [i for i, name in enumerate(names) if any(part in name for part in parts)]


def build_model(spec: mujoco.MjSpec, contact_geoms: list[str]) -> mujoco.MjModel:
    """Compile the model to simulate, without visuals and with contact sensors.

    Bodies without joints are merged into their parents, unless something refers to them. Each of ``contact_geoms`` has
    a sensor of its contacts with the floor and other parts of the robot, in this order. The model has no other sensors.
    """
    spec.compiler.discardvisual = spec.compiler.fusestatic = True
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for name in contact_geoms:
        spec.add_sensor(
            name=f"{name}_contact",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=name,  # as the second geom: the force is the one that the first geom exerts on it
            intprm=[_DATASPEC, _REDUCE_NETFORCE, 1],
        )
    return spec.compile()


def use_known_options(model: mujoco.MjModel) -> None:
    """Replace options that MuJoCo Warp refuses although they change no motion: some flags, and the PGS solver."""
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE | mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_FWDINV)
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON  # finds the same minimum


def max_contacts(model: mujoco.MjModel) -> int:
    """Return the most contacts that one world can have: one per sphere, two per capsule, eight per other geom.

    On a height field, every geom has four at most: those that MuJoCo Warp keeps.
    """
    on_hfield = int(mujoco.mjtGeom.mjGEOM_HFIELD)
    per_type = {int(mujoco.mjtGeom.mjGEOM_SPHERE): 1, int(mujoco.mjtGeom.mjGEOM_CAPSULE): 2}
    kinds = model.geom_type[colliding_pairs(model)].tolist()
    return sum(4 if on_hfield in pair else min(per_type.get(kind, 8) for kind in pair) for pair in kinds)


_EQUALITY_ROWS = {int(mujoco.mjtEq.mjEQ_CONNECT): 3, int(mujoco.mjtEq.mjEQ_WELD): 6}  # others have one


def max_constraints(model: mujoco.MjModel, contacts: int) -> int:
    """Return the most constraint rows that one world can have (pyramidal friction cones).

    Every joint may have dry friction in some world.
    """
    rows_per_contact = 2 * (int(model.geom_condim.max()) - 1)
    friction = model.nv + int((model.tendon_frictionloss > 0).sum())
    equalities = sum(_EQUALITY_ROWS.get(int(kind), 1) for kind in model.eq_type)
    limits = int(model.jnt_limited.sum() + model.tendon_limited.sum())
    return contacts * rows_per_contact + friction + limits + equalities
