"""The robot of an MJCF file in plain MuJoCo, compared with ``policy.yaml``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_torque.deploy import hfield_contacts
from legged_torque.deploy.ground import ground_heights, place_ground
from legged_torque.deploy.joints import find_joints
from legged_torque.deploy.policy import State
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import drawing_notes, exclude_self_collisions, loading, self_pairs

_WARNINGS = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


class MujocoRobot:
    """One robot in MuJoCo; vectors of joints are in the policy's order and about its axes, not the file's.

    Attributes:
        file: The MJCF.
        model: The compiled MJCF, with the policy's time step.
        data: Its state.
        notes: Differences from the training, a line each.
        trunk: Number of the trunk's body.
        position: The trunk's position in the world, a view of the state like the next ones [m]. Shape: (3,).
        quat: The trunk's orientation (w, x, y, z). Shape: (4,).
        velocity: The trunk's linear velocity in the world [m/s]. Shape: (3,).
        angular_velocity: The trunk's angular velocity in its own frame [rad/s]. Shape: (3,).
        joints: The policy's joints and motors.
        weight: m g of the whole robot [N].
        origins: Where episodes may start: the middles of the ground's tiles, or the origin [m]. Shape: (places, 3).
    """

    def __init__(self, xml: str | Path, description: dict[str, Any], contacts: str = "training") -> None:
        """Load the robot of an MJCF file.

        Args:
            xml: The file, with or without a floor.
            description: Contents of ``policy.yaml``.
            contacts: Whose contacts with height fields act, "training" or "mujoco".

        Raises:
            UserError: If the file cannot be read, or lacks a joint or a motor that the policy needs.
        """
        self.notes: list[str] = []
        self.file = Path(xml)
        self.model, self.origins = self._load(self.file, description)
        self.data = mujoco.MjData(self.model)
        old, step = self.model.opt.timestep, 1.0 / description["timing"]["physics_frequency"]
        if not np.isclose(old, step, rtol=1e-6):
            self.notes.append(f"time step: the MJCF has {old:g} s, policy.yaml's {step:g} s is used")
        self.model.opt.timestep = step
        self._step = hfield_contacts.STEPS[contacts]
        if self.model.nhfield:
            self.notes.append(hfield_contacts.NOTES[contacts])
        self._find_root()
        self.joints = find_joints(self.model, description)
        self.notes += self.joints.notes
        others = self.model.nu - len(self.joints.motors)
        if others:
            self.notes.append(f"{others} motors of the MJCF are not driven by the policy and get 0")
        self._find_geoms(description["episode"]["ends_on_contact_of"])
        collides = description["robot"]["self_collisions"]
        self._is_felt = self._is_ground | (collides & (self.model.body_rootid[self.model.geom_bodyid] == self.trunk))
        self.weight = float(self.model.body_mass.sum() * np.linalg.norm(self.model.opt.gravity))

    # ---- sensors and motors ------------------------------------------------------------------------------------------

    def state(self) -> State:
        """Return the measurements of perfect sensors."""
        angular_velocity, quat = self.angular_velocity.copy(), self.quat.copy()
        return State(angular_velocity, self.joint_positions(), self.joint_velocities(), quaternion=quat)

    def joint_positions(self) -> np.ndarray:
        """Return joint positions. Shape: (joints,) [rad]."""
        return self.joints.signs * self.data.qpos[self.joints.qpos]

    def joint_velocities(self) -> np.ndarray:
        """Return joint velocities. Shape: (joints,) [rad/s]."""
        return self.joints.signs * self.data.qvel[self.joints.dofs]

    def applied_torques(self) -> np.ndarray:
        """Return the motors' torques in the last physics step. Shape: (joints,) [N m]."""
        return self.joints.signs * self.data.qfrc_actuator[self.joints.dofs]

    def step(self, torques: np.ndarray) -> None:
        """Advance by one physics step with torques of shape (joints,) [N m]."""
        self.data.ctrl[self.joints.motors] = torques / self.joints.torque_per_control
        self._step(self.model, self.data)

    def planar_velocity(self) -> np.ndarray:
        """Return v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame, as commands are. Shape: (3,)."""
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, self.quat)
        return np.append((matrix.reshape(3, 3).T @ self.velocity)[:2], self.angular_velocity[2])

    def reset(
        self, position: np.ndarray, quat: np.ndarray, joint_positions: np.ndarray, velocities: tuple[np.ndarray, ...]
    ) -> None:
        """Put the robot into a state, everything else as in the MJCF.

        Args:
            position: Of the trunk [m]. Shape: (3,).
            quat: Orientation of the trunk (w, x, y, z). Shape: (4,).
            joint_positions: Clipped to the joint limits [rad]. Shape: (joints,).
            velocities: Linear velocity of the trunk in the world [m/s], angular velocity in its own frame [rad/s],
                and velocities of the joints [rad/s]. Shapes: (3,), (3,), (joints,).
        """
        mujoco.mj_resetData(self.model, self.data)
        self.position[:], self.quat[:] = position, quat
        self.data.qpos[self.joints.qpos] = self.joints.signs * np.clip(joint_positions, *self.joints.limits)
        self.velocity[:], self.angular_velocity[:] = velocities[:2]
        self.data.qvel[self.joints.dofs] = self.joints.signs * velocities[2]
        mujoco.mj_kinematics(self.model, self.data)  # places the ground

    # ---- the ground --------------------------------------------------------------------------------------------------

    def ground_heights(self, places: np.ndarray) -> np.ndarray:
        """Return heights of the ground at x and y of places, -inf where there is none. Shapes: (n, 2), (n,) [m]."""
        return ground_heights(self.model, self.data, self._grounds, places)

    def height(self) -> float:
        """Return the height of the trunk's origin above the ground; infinite where there is none [m]."""
        return float(self.position[2] - self.ground_heights(self.position[np.newaxis, :2])[0])

    # ---- contacts ----------------------------------------------------------------------------------------------------

    def has_fallen(self) -> bool:
        """Return whether a geom that ends episodes touched the ground or another part of the robot in the last step.

        A robot has also fallen if it has left the ground, or its state has diverged.
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

        Contacts between parts of the robot are included, twice each, if these collided in training.
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
        """Compile the file with the policy's ground; return it with the places where episodes may start."""
        with loading(file):
            spec = mujoco.MjSpec.from_file(str(file))
            self.notes += drawing_notes(spec)
            origins = place_ground(spec, description, self.notes)
            model = spec.compile()
            collided, pairs = description["robot"]["self_collisions"], len(self_pairs(model))
            if pairs and not collided:
                exclude_self_collisions(spec, model)
                model = spec.compile()
                self.notes.append(f"{pairs} pairs of parts that the MJCF lets collide do not, as in training")
            if collided and not pairs:
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

    def _find_geoms(self, ends_on_contact_of: list[str]) -> None:
        """Find the ground and the geoms whose contact ends an episode: by parts of names, else those of the trunk."""
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
