"""What of the joints of a MJCF is otherwise than in ``policy.yaml``, which tells how they were in training."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from legged_torque.deploy.description import DESCRIPTION_FILE
from legged_torque.utils.mjcf import joint_axes, joint_limits

MASS_TOLERANCE = 1e-3  # share of the mass below which robots count as equally heavy
ALIKE = 0.999  # least cosine between axes that count as parallel


def axis_signs(model: mujoco.MjModel, joints: np.ndarray, description: dict[str, Any]) -> np.ndarray:
    """Return -1 for joints whose axes point the other way than the policy's, else 1. Shape: (joints,)."""
    along = _along(model, joints, description)
    return np.where(along < -ALIKE, -1.0, 1.0)


def policy_limits(model: mujoco.MjModel, joints: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Return lowest and highest positions of joints about the policy's axes. Shape: (2, joints) [rad]."""
    return np.sort(joint_limits(model)[joints].T * signs, axis=0)


def joint_notes(model: mujoco.MjModel, joints: np.ndarray, description: dict[str, Any]) -> Iterator[str]:
    """Yield a line for each difference of mass, axes, limits, and passive forces, with the joints that it concerns."""
    mass, trained = float(model.body_mass.sum()), description["robot"].get("mass")
    if trained and not np.isclose(mass, trained, rtol=MASS_TOLERANCE):
        yield f"mass: the MJCF has {mass:.3f} kg, the robot of the training {trained:.3f} kg"
    along = _along(model, joints, description)
    turned = {"axes: those of the MJCF point the other way; angles and torques are negated": along < -ALIKE}
    turned["axes: those of the MJCF are not the policy's"] = np.abs(along) <= ALIKE
    pose = np.array([description["nominal_pose"][name] for name in description["joint_order"]])
    low, high = policy_limits(model, joints, axis_signs(model, joints, description))
    beyond = (pose < low - 1e-6) | (pose > high + 1e-6)
    turned["nominal pose: beyond the joint limits of the MJCF, where episodes start instead"] = beyond
    for note, where in (turned | _passive_forces(model, joints, description)).items():
        if where.any():
            names = [name for name, is_meant in zip(description["joint_order"], where, strict=True) if is_meant]
            yield f"{note} ({', '.join(names) if len(names) < len(joints) else 'all joints'})"
    if "joints" not in description:
        yield f"axes, damping, armature and friction of joints are not compared: {DESCRIPTION_FILE} lacks them"


def _passive_forces(model: mujoco.MjModel, joints: np.ndarray, description: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return which joints have which other passive forces or armatures. Shapes: (joints,), bool."""
    result = {}
    trained = [description["joints"][name] for name in description["joint_order"]] if "joints" in description else []
    for field in ("damping", "armature", "frictionloss") if trained else ():
        own = getattr(model, f"dof_{field}")[model.jnt_dofadr[joints]].tolist()
        pairs = list(zip(own, [joint[field] for joint in trained], strict=True))
        for pair in sorted(set(pairs)):
            if not np.isclose(*pair, rtol=1e-4, atol=1e-9):
                note = f"{field} of joints: the MJCF has {pair[0]:g}, the robot of the training {pair[1]:g}"
                result[note] = np.array([other == pair for other in pairs])
    return result


def _along(model: mujoco.MjModel, joints: np.ndarray, description: dict[str, Any]) -> np.ndarray:
    """Return the cosines between the axes of joints and the policy's; 1 where these are not known. Shape: (joints,)."""
    if "joints" not in description:
        return np.ones(len(joints))
    axes = [description["joints"][name]["axis"] for name in description["joint_order"]]
    return (joint_axes(model)[joints] * axes).sum(axis=1)
