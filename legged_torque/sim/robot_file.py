"""Requirements on a robot's MJCF that hold for every engine."""

from collections import defaultdict
from collections.abc import Iterator

import mujoco
import numpy as np

from legged_torque.sim.model import FLOOR
from legged_torque.utils.errors import with_names
from legged_torque.utils.mjcf import motors_of, torque_range, why_no_motor

_ONE_NUMBER = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))  # types of joints


def spec_problems(spec: mujoco.MjSpec) -> Iterator[str]:
    """Yield problems with the trunk, the floor and names of geoms."""
    trunks = [body for body in spec.worldbody.bodies if any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in body.joints)]
    if len(trunks) != 1:
        yield f"it must have one body with a free joint, the trunk, not {len(trunks)}"
    if FLOOR not in [geom.name for geom in spec.worldbody.geoms]:
        yield f"it must have a geom '{FLOOR}' in its worldbody, on which it stands"
    unnamed = [geom for geom in spec.geoms if not geom.name and (geom.contype or geom.conaffinity)]
    bodies = dict.fromkeys(f"'{geom.parent.name}'" for geom in unnamed)
    if unnamed:
        yield f"geoms that collide need names, by which settings refer to them; those of {', '.join(bodies)} have none"


def model_problems(model: mujoco.MjModel) -> Iterator[str]:
    """Yield problems with joints, motors and masses."""
    yield from joint_problems(model)
    yield from motor_problems(model)
    if not np.isfinite([*model.body_mass, *model.body_inertia.flat]).all():
        yield "it has a mass or an inertia that is not finite"


def joint_problems(model: mujoco.MjModel) -> Iterator[str]:
    """Yield problems with the joints: the trunk's must be the first, all others below it, and each must have a name."""
    if not model.njnt or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        yield "its first joint must be the trunk's free joint"
        return
    trunk = model.jnt_bodyid[0]
    if trunk != 1:
        yield f"the trunk '{model.body(trunk).name}' must be the first body, before '{model.body(1).name}'"
    for joint in range(1, model.njnt):
        name, body = model.joint(joint).name, model.jnt_bodyid[joint]
        if not name:
            yield f"a joint of the body '{model.body(body).name}' has no name"
        if model.jnt_type[joint] not in _ONE_NUMBER:
            yield f"the joint '{name}' must be a hinge"
        elif model.body_rootid[body] != trunk:
            yield f"the joint '{name}' does not hang on the trunk '{model.body(trunk).name}'"


def motor_problems(model: mujoco.MjModel) -> Iterator[str]:
    """Yield problems with the motors: each joint must have one of its own, with limits."""
    yield from actuator_problems(model)
    wrong = defaultdict[str, list[str]](list)
    for joint in range(1, model.njnt):
        name, motors = model.joint(joint).name, motors_of(model, joint)
        if len(motors) != 1:
            wrong[f"each joint must have one motor, not {len(motors)}"].append(name)
        elif not -np.inf < np.subtract(*torque_range(model, motors[0])) < 0.0:  # lowest less highest
            wrong["motors need torque limits, for example a forcerange"].append(name)
    yield from with_names(wrong)
    if model.opt.disableactuator or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
        yield "its options switch actuators off"


def actuator_problems(model: mujoco.MjModel) -> Iterator[str]:
    """Yield actuators that are not motors: their controls would not be the torques that tasks send."""
    wrong = defaultdict[str, list[str]](list)
    for actuator in range(model.nu):
        reason = why_no_motor(model, actuator)
        if reason:
            wrong[f"make a <motor> with a forcerange of what {reason}"].append(_name(model, actuator))
    yield from with_names(wrong)


def use_plain_motors(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Put the motors of a file without problems in the order of its joints and make their controls torques.

    Each becomes a motor without gear, limited by the tightest limits in the file, in ``spec``, of which ``model`` was
    compiled.
    """
    joints = range(1, model.njnt)
    motors = [motors_of(model, joint)[0] for joint in joints]
    names = [_name(model, motor) for motor in motors]
    limits = [torque_range(model, motor) for motor in motors]
    for place, actuator in enumerate(spec.actuators):
        actuator.name = f"motor {place}"  # names must be unique at all times
    for actuator, joint, name, limit in zip(spec.actuators, joints, names, limits, strict=True):
        actuator.name, actuator.target = name, model.joint(joint).name
        actuator.gainprm[0], actuator.gear = 1.0, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        actuator.ctrlrange = actuator.forcerange = limit
        actuator.ctrllimited = actuator.forcelimited = True
        spec.joint(model.joint(joint).name).actfrclimited = False
    for key in spec.keys:
        key.ctrl = []  # in the old order and units


def _name(model: mujoco.MjModel, actuator: int) -> str:
    """Return the name of an actuator, or of its joint if it has none."""
    joint = model.actuator_trnid[actuator, 0]
    on_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
    return model.actuator(actuator).name or (model.joint(joint).name if on_joint else str(actuator))
