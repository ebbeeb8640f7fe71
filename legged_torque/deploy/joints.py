"""The policy's joints and their motors in a MJCF, and how they differ from those of the training."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from legged_torque.utils.errors import unknown_name
from legged_torque.utils.mjcf import (
    joint_axes,
    joint_limits,
    motors_of,
    torque_per_control,
    torque_range,
    why_no_motor,
)
from legged_torque.utils.problems import refuse, with_names

MASS_TOLERANCE = 1e-3  # share of the mass below which robots count as equally heavy
PARALLEL = 0.999  # least cosine between axes that count as parallel
_ONE_NUMBER = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))  # types of joints


@dataclass
class Joints:
    """The policy's joints in a model, in the policy's order. Shapes: (joints,) unless stated otherwise."""

    qpos: np.ndarray  # addresses of positions in qpos
    dofs: np.ndarray  # addresses of velocities in qvel
    motors: np.ndarray  # actuators
    signs: np.ndarray  # -1 where the axis points the other way than the policy's, else 1
    limits: np.ndarray  # lowest and highest positions about the policy's axes [rad]. Shape: (2, joints)
    torque_per_control: np.ndarray  # about the policy's axes [N m]
    notes: list[str]  # differences from the training, a line each


def find_joints(model: mujoco.MjModel, description: dict[str, Any]) -> Joints:
    """Find the joints of ``policy.yaml`` by name, and their motors by transmission.

    A UserError, which lists all problems, if a joint is missing or has no motor of its own.
    """
    order = description["joint_order"]
    names = {model.joint(i).name: i for i in range(model.njnt) if model.jnt_type[i] in _ONE_NUMBER}
    missing = [name for name in order if name not in names]
    refuse([str(unknown_name("joint of the policy in the MJCF", name, names)) for name in missing])
    ids = [names[name] for name in order]
    motors = _find_motors(model, dict(zip(order, ids, strict=True)))
    axes = [description["joints"][name]["axis"] for name in order]
    cosines = (joint_axes(model)[ids] * axes).sum(axis=1)
    signs = np.where(cosines < -PARALLEL, -1.0, 1.0)
    joints = Joints(
        qpos=model.jnt_qposadr[ids],
        dofs=model.jnt_dofadr[ids],
        motors=motors,
        signs=signs,
        limits=np.sort(joint_limits(model)[ids].T * signs, axis=0),
        torque_per_control=signs * [torque_per_control(model, motor) for motor in motors],
        notes=[],
    )
    mass, trained = float(model.body_mass.sum()), description["robot"]["mass"]
    if not np.isclose(mass, trained, rtol=MASS_TOLERANCE):
        joints.notes.append(f"mass: the MJCF has {mass:.3f} kg, the robot of the training {trained:.3f} kg")
    different = _differences(model, joints, cosines, description)
    for note, names_of in different.items():
        joints.notes.append(f"{note} ({', '.join(names_of) if len(names_of) < len(order) else 'all joints'})")
    return joints


def _find_motors(model: mujoco.MjModel, joints: dict[str, int]) -> np.ndarray:
    """Return the motor of each joint by name; a UserError where there is not exactly one."""
    motors, wrong = list[int](), defaultdict[str, list[str]](list)
    for name, joint in joints.items():
        found = motors_of(model, joint)
        reason = why_no_motor(model, found[0]) if len(found) == 1 else ""
        if len(found) != 1:
            wrong[f"each joint of the policy must have one motor in the MJCF, not {len(found)}"].append(name)
        elif reason:
            wrong[f"each joint's actuator must be a motor, ctrl its torque; one {reason}"].append(name)
        motors += found[:1]
    refuse(list(with_names(wrong)))
    return np.array(motors)


def _differences(
    model: mujoco.MjModel, joints: Joints, cosines: np.ndarray, description: dict[str, Any]
) -> dict[str, list[str]]:
    """Return what differs from the training, with the names of the joints that it concerns.

    ``cosines`` are those between the axes of the MJCF and the policy's. Shape: (joints,).
    """
    different = defaultdict[str, list[str]](list)
    for i, name in enumerate(description["joint_order"]):
        trained, (low, high) = description["joints"][name], joints.limits[:, i]
        if cosines[i] < -PARALLEL:
            different["axes: those of the MJCF point the other way; angles and torques are negated"].append(name)
        elif cosines[i] <= PARALLEL:
            different["axes: those of the MJCF are not the policy's"].append(name)
        if not low - 1e-6 <= description["nominal_pose"][name] <= high + 1e-6:
            note = "nominal pose: beyond the joint limits of the MJCF, where episodes start instead"
            different[note].append(name)
        for field in ("damping", "armature", "frictionloss"):
            own = float(getattr(model, f"dof_{field}")[joints.dofs[i]])
            if not np.isclose(own, trained[field], rtol=1e-4, atol=1e-9):
                note = f"{field} of joints: the MJCF has {own:g}, the robot of the training {trained[field]:g}"
                different[note].append(name)
        weakest, strongest = sorted(joints.signs[i] * limit for limit in torque_range(model, joints.motors[i]))
        limits = description["torque_limits"][name]
        if not np.allclose((weakest, strongest), limits, rtol=1e-4):
            here, there = f"{weakest:g} to {strongest:g} N m", f"{limits[0]:g} to {limits[1]:g} N m"
            different[f"motor limits: the MJCF has {here}, policy.yaml {there}; the tighter ones act"].append(name)
    return different
