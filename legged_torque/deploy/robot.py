"""The robot of an MJCF file: finds joints, motors and ground, and compares them with ``policy.yaml``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_torque.deploy import hfield_contacts
from legged_torque.deploy.differences import axis_signs, joint_notes, policy_limits
from legged_torque.deploy.ground import ground_heights, place_ground
from legged_torque.deploy.policy import State
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.mjcf import (
    drawing_notes,
    exclude_self_collisions,
    loading,
    motors_of,
    self_pairs,
    torque_per_control,
    torque_range,
    why_no_motor,
)

_WARNINGS = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
_JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


class MujocoRobot:
    """One robot in MuJoCo; vectors of joints are in the policy's order and about its axes, not the file's.

    Attributes:
        file: The MJCF.
        model: The compiled MJCF, with the policy's time step.
        data: Its state.
        notes: Differences of the MJCF from ``policy.yaml``, a line each.
        trunk: Number of the trunk's body.
        position: The trunk's position in the world, a view of the state like the next ones [m]. Shape: (3,).
        quat: The trunk's orientation (w, x, y, z). Shape: (4,).
        velocity: The trunk's linear velocity in the world [m/s]. Shape: (3,).
        angular_velocity: The trunk's angular velocity in its own frame [rad/s]. Shape: (3,).
        weight: m g of the whole robot [N].
        origins: Where episodes may start: the middles of the ground's tiles, or the origin [m]. Shape: (places, 3).
    """

    def __init__(self, xml: str | Path, description: dict[str, Any]) -> None:
        """Load the robot of an MJCF file, with or without a floor; ``description`` are the contents of ``policy.yaml``.

        A UserError if the file cannot be read, or lacks a joint or a motor that the policy needs.
        """
        self.notes: list[str] = []
        self.file = Path(xml)
        self.model, self.origins = self._load(self.file, description)
        self.data = mujoco.MjData(self.model)
        old, step = self.model.opt.timestep, 1.0 / description["timing"]["physics_frequency"]
        if not np.isclose(old, step, rtol=1e-6):
            self.notes.append(f"time step: the MJCF has {old:g} s, policy.yaml's {step:g} s is used")
        self.model.opt.timestep = step
        self._find_root()
        self._find_joints(description)
        self.notes += joint_notes(self.model, self._joint_ids, description)
        self._find_motors(description)
        self._find_geoms(description["episode"]["ends_on_contact_of"])
        collides = description["robot"].get("self_collisions", False)
        self._is_felt = self._is_ground | (collides & (self.model.body_rootid[self.model.geom_bodyid] == self.trunk))
        self.weight = float(self.model.body_mass.sum() * np.linalg.norm(self.model.opt.gravity))

    # ---- sensors and motors ------------------------------------------------------------------------------------------

    def state(self) -> State:
        """Return the measurements of perfect sensors."""
        angular_velocity, quat = self.angular_velocity.copy(), self.quat.copy()
        return State(angular_velocity, self.joint_positions(), self.joint_velocities(), quaternion=quat)

    def joint_positions(self) -> np.ndarray:
        """Return joint positions. Shape: (joints,) [rad]."""
        return self._signs * self.data.qpos[self._qpos]

    def joint_velocities(self) -> np.ndarray:
        """Return joint velocities. Shape: (joints,) [rad/s]."""
        return self._signs * self.data.qvel[self._dofs]

    def applied_torques(self) -> np.ndarray:
        """Return the motors' torques in the last physics step. Shape: (joints,) [N m]."""
        return self._signs * self.data.qfrc_actuator[self._dofs]

    def step(self, torques: np.ndarray) -> None:
        """Advance by one physics step with torques of shape (joints,) [N m]."""
        self.data.ctrl[self._motors] = torques / self._torque_per_ctrl
        hfield_contacts.step(self.model, self.data)

    def planar_velocity(self) -> np.ndarray:
        """Return v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame, as commands are. Shape: (3,)."""
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, self.quat)
        return np.append((matrix.reshape(3, 3).T @ self.velocity)[:2], self.angular_velocity[2])

    def reset(
        self, position: np.ndarray, quat: np.ndarray, joint_positions: np.ndarray, velocities: tuple[np.ndarray, ...]
    ) -> None:
        """Put the robot into a state, everything else as in the MJCF; joint positions are brought inside their limits.

        Position [m], quaternion (w, x, y, z), and of ``velocities`` the linear one (world) [m/s] and the angular one
        (trunk) [rad/s], are the trunk's; the third of ``velocities`` is that of the joints. Shape: (joints,) [rad/s].
        """
        mujoco.mj_resetData(self.model, self.data)
        self.position[:], self.quat[:] = position, quat
        self.data.qpos[self._qpos] = self._signs * np.clip(joint_positions, *self._joint_limits)
        self.velocity[:], self.angular_velocity[:] = velocities[:2]
        self.data.qvel[self._dofs] = self._signs * velocities[2]
        mujoco.mj_kinematics(self.model, self.data)  # places the ground

    # ---- the ground --------------------------------------------------------------------------------------------------

    def ground_heights(self, places: np.ndarray) -> np.ndarray:
        """Return how high the ground is at x and y of places, -inf where there is none. Shapes: (n, 2), (n,) [m]."""
        return ground_heights(self.model, self.data, self._grounds, places)

    def height(self) -> float:
        """Return how high the trunk's origin is above the ground under it; infinite where there is none [m]."""
        return float(self.position[2] - self.ground_heights(self.position[np.newaxis, :2])[0])

    # ---- contacts ----------------------------------------------------------------------------------------------------

    def has_fallen(self) -> bool:
        """Return whether a geom that ends an episode touched something in the last step, or the state diverged.

        That is the ground or another part of the robot. A robot that has left the ground's edge has fallen, too.
        """
        if any(self.data.warning[kind].number for kind in _WARNINGS) or math.isinf(self.height()):
            return True
        return any(self._is_ending[geom] for _, geom, _ in self._contacts())

    def contact_force(self) -> float:
        """Return the sum over geoms of the norm of the net contact force on them in the last physics step [N]."""
        forces, force = np.zeros((self.model.ngeom, 3)), np.zeros(6)
        for number, geom, sign in self._contacts():
            mujoco.mj_contactForce(self.model, self.data, number, force)
            forces[geom] += sign * self.data.contact[number].frame.reshape(3, 3).T @ force[:3]
        return float(np.linalg.norm(forces, axis=1).sum())

    def _contacts(self) -> list[tuple[int, int, float]]:
        """Return number, geom of the robot, and the force's sign on it, of each contact with the ground.

        Those between parts of the robot are there as well, twice each, if these collided in training.
        """
        result = []
        for number, contact in enumerate(self.data.contact):
            first, second = contact.geom
            for geom, other, sign in ((first, second, -1.0), (second, first, 1.0)):
                if contact.exclude == 0 and not self._is_ground[geom] and self._is_felt[other]:
                    result.append((number, geom, sign))
        return result

    # ---- reading the MJCF --------------------------------------------------------------------------------------------

    def _load(self, file: Path, description: dict[str, Any]) -> tuple[mujoco.MjModel, np.ndarray]:
        """Compile the file with the policy's ground, and return it with the places where episodes may start."""
        with loading(file):
            spec = mujoco.MjSpec.from_file(str(file))
            self.notes += drawing_notes(spec)
            origins = place_ground(spec, description, self.notes)
            model = spec.compile()
            collided, pairs = description["robot"].get("self_collisions", True), len(self_pairs(model))
            if pairs and not collided:
                exclude_self_collisions(spec, model)
                model = spec.compile()
                self.notes.append(f"{pairs} pairs of parts that the MJCF lets collide do not, as in training")
            if "self_collisions" in description["robot"] and collided and not pairs:
                self.notes.append("parts of the robot collided with each other in training, those of the MJCF do not")
            return model, origins

    def _find_root(self) -> None:
        """Find the free joint of the trunk."""
        (free,) = np.nonzero(self.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        if len(free) != 1:
            raise UserError(f"the MJCF must have one free joint, that of the trunk; it has {len(free)}")
        self.trunk = int(self.model.jnt_bodyid[free[0]])
        qpos, qvel = self.data.joint(int(free[0])).qpos, self.data.joint(int(free[0])).qvel
        self.position, self.quat = qpos[:3], qpos[3:]
        self.velocity, self.angular_velocity = qvel[:3], qvel[3:]

    def _find_joints(self, description: dict[str, Any]) -> None:
        """Find the policy's joints by name, and which of them turn about an axis that points the other way."""
        joint_order = description["joint_order"]
        model, problems = self.model, list[str]()
        names = {model.joint(i).name: i for i in range(model.njnt) if model.jnt_type[i] in _JOINTS}
        for name in joint_order:
            if name not in names:
                problems.append(str(unknown_name("joint of the policy in the MJCF", name, names)))
        _refuse(problems)
        self._joint_ids = np.array([names[name] for name in joint_order])
        self._qpos, self._dofs = model.jnt_qposadr[self._joint_ids], model.jnt_dofadr[self._joint_ids]
        self._signs = axis_signs(model, self._joint_ids, description)
        self._joint_limits = policy_limits(model, self._joint_ids, self._signs)

    def _find_motors(self, description: dict[str, Any]) -> None:
        """Find the motor of each joint by its transmission, and compare its limits with the policy's."""
        model, motors, problems = self.model, list[int](), list[str]()
        different: dict[tuple[tuple[float, float], tuple[float, float]], list[str]] = {}
        for name, joint, sign in zip(description["joint_order"], self._joint_ids, self._signs, strict=True):
            found = motors_of(model, joint)
            reason = why_no_motor(model, found[0]) if len(found) == 1 else ""
            if len(found) != 1:
                problems.append(f"the MJCF must have one motor for the joint '{name}', it has {len(found)}")
            elif reason:
                problems.append(
                    f"the MJCF's actuator of the joint '{name}' must be a motor, ctrl its torque; it {reason}"
                )
            else:
                motors.append(found[0])
                low, high = sorted(sign * limit for limit in torque_range(model, found[0]))
                if not np.allclose((low, high), description["torque_limits"][name], rtol=1e-4):
                    different.setdefault(((low, high), tuple(description["torque_limits"][name])), []).append(name)
        _refuse(problems)
        self._motors = np.array(motors)
        self._torque_per_ctrl = self._signs * [torque_per_control(model, motor) for motor in motors]
        for (limits, expected), names in different.items():
            self.notes.append(
                f"motor limits: the MJCF has {limits[0]:g} to {limits[1]:g} N m, policy.yaml {expected[0]:g} to "
                f"{expected[1]:g} N m; the tighter ones act ({', '.join(names)})"
            )
        if model.nu > len(motors):
            self.notes.append(f"{model.nu - len(motors)} motors of the MJCF are not driven by the policy and get 0")

    def _find_geoms(self, ends_on_contact_of: list[str]) -> None:
        """Find the ground, and the geoms whose contact with it ends an episode: by name, or those of the trunk."""
        model = self.model
        self._is_ground = model.body_weldid[model.geom_bodyid] == 0
        (self._grounds,) = np.nonzero(self._is_ground & (model.geom_contype | model.geom_conaffinity != 0))
        names = [model.geom(i).name or model.body(model.geom_bodyid[i]).name for i in range(model.ngeom)]
        matching = {part: np.array([part in name for name in names]) & ~self._is_ground for part in ends_on_contact_of}
        is_ending = np.any([np.zeros(model.ngeom, bool), *matching.values()], axis=0)
        missing = ", ".join(part for part, geoms in matching.items() if not geoms.any())
        if missing and is_ending.any():
            self.notes.append(f"no geom's name contains {missing}: it ends no episode")
        elif missing:
            trunk = model.body(self.trunk).name
            self.notes.append(f"no geom's name contains {missing}: those of '{trunk}' end an episode")
            is_ending = model.geom_bodyid == self.trunk
        self._is_ending = is_ending


def _refuse(problems: list[str]) -> None:
    """Raise a UserError with all problems of a MJCF in one line, if there are any."""
    if problems:
        raise UserError("; ".join(problems))
