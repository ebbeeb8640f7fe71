"""The robot of an MJCF file in plain MuJoCo, compared with ``policy.yaml``."""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_torque.deploy import ground
from legged_torque.deploy.policy import State
from legged_torque.utils import mjcf
from legged_torque.utils.errors import UserError, refuse, unknown_name, with_names

MASS_TOLERANCE = 1e-3  # share of the mass below which robots count as equally heavy
PARALLEL = 0.999  # least cosine between axes that count as parallel
_ABOVE = 100.0  # height from which rays look down on the ground [m]
_WARNINGS = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


def joints_and_motors(model: mujoco.MjModel, order: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return numbers of joints by name, and of their motors by transmission.

    A UserError, which lists all problems, if a joint is missing or has no motor of its own.
    """
    hinge_or_slide = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    names = {model.joint(i).name: i for i in range(model.njnt) if model.jnt_type[i] in hinge_or_slide}
    missing = [name for name in order if name not in names]
    refuse([str(unknown_name("joint of the policy in the MJCF", name, names)) for name in missing])
    ids, motors, wrong = [names[name] for name in order], list[int](), defaultdict[str, list[str]](list)
    for name, joint in zip(order, ids, strict=True):
        found = mjcf.motors_of(model, joint)
        reason = mjcf.why_no_motor(model, found[0]) if len(found) == 1 else ""
        if len(found) != 1:
            wrong[f"each joint of the policy must have one motor in the MJCF, not {len(found)}"].append(name)
        elif reason:
            wrong[f"each joint's actuator must be a motor, ctrl its torque; one {reason}"].append(name)
        motors += found[:1]
    refuse(list(with_names(wrong)))
    return ids, motors


class MujocoRobot:
    """One robot in MuJoCo; vectors of joints are in the policy's order and about its axes, not the file's.

    Attributes:
        file: The MJCF.
        spec: The MJCF as it was compiled, with the ground.
        model: The compiled MJCF, with the policy's time step.
        data: Its state.
        trunk: Number of the trunk's body.
        position: The trunk's position in the world, a view of the state like the next ones [m]. Shape: (3,).
        quat: The trunk's orientation (w, x, y, z). Shape: (4,).
        velocity: The trunk's linear velocity in the world [m/s]. Shape: (3,).
        angular_velocity: The trunk's angular velocity in its own frame [rad/s]. Shape: (3,).
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
        self.file, self._notes, self._description = Path(xml), list[str](), description
        collided = description["robot"]["self_collisions"]
        with mjcf.loading(self.file):
            spec = mujoco.MjSpec.from_file(str(self.file))
            self._notes += mjcf.drawing_notes(spec)
            self.origins = ground.place_ground(spec, description, self._notes)
            self.model = spec.compile()
            pairs = len(mjcf.self_pairs(self.model))
            if pairs and not collided:
                mjcf.exclude_self_collisions(spec, self.model)
                self.model = spec.compile()
                self._notes.append(f"{pairs} pairs of parts that the MJCF lets collide do not, as in training")
            if collided and not pairs:
                self._notes.append("parts of the robot collided with each other in training, those of the MJCF do not")
        self.spec = spec
        self.data = mujoco.MjData(self.model)
        old, step = self.model.opt.timestep, 1.0 / description["timing"]["physics_frequency"]
        if not np.isclose(old, step, rtol=1e-6):
            self._notes.append(f"time step: the MJCF has {old:g} s, policy.yaml's {step:g} s is used")
        self.model.opt.timestep = step
        self._step = ground.step if contacts == "training" else mujoco.mj_step
        if self.model.nhfield:
            self._notes.append(ground.CONTACT_NOTES[contacts])
        (free,) = np.nonzero(self.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        if len(free) != 1:
            raise UserError(f"the MJCF must have one free joint, that of the trunk; it has {len(free)}")
        self.trunk = int(self.model.jnt_bodyid[free[0]])
        qpos, qvel = self.data.joint(int(free[0])).qpos, self.data.joint(int(free[0])).qvel
        self.position, self.quat = qpos[:3], qpos[3:]
        self.velocity, self.angular_velocity = qvel[:3], qvel[3:]
        self._find_joints(description)
        others = self.model.nu - len(self._motors)
        if others:
            self._notes.append(f"{others} motors of the MJCF are not driven by the policy and get 0")
        self._find_geoms(description["episode"]["ends_on_contact_of"], collided)
        self.weight = float(self.model.body_mass.sum() * np.linalg.norm(self.model.opt.gravity))

    @property
    def notes(self) -> list[str]:
        """Differences from the training as they are now, a line each."""
        return [*self._notes, *self._joint_notes()]

    def addresses(self) -> dict[str, list[Any]]:
        """Return indices into MuJoCo's arrays of the policy's joints and motors, and of geoms that end episodes.

        Angles about the policy's axes are ``signs`` times MuJoCo's, and ``ctrl`` is a torque by ``torque_per_control``.
        """
        found = {"qpos": self._qpos, "dofs": self._dofs, "motors": self._motors, "signs": self._signs}
        found |= {"torque_per_control": self._torque_per_control, "ending_geoms": np.flatnonzero(self._is_ending)}
        return {name: values.tolist() for name, values in found.items()}

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
        self.data.ctrl[self._motors] = torques / self._torque_per_control
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
        self.data.qpos[self._qpos] = self._signs * np.clip(joint_positions, *self._limits)
        self.velocity[:], self.angular_velocity[:] = velocities[:2]
        self.data.qvel[self._dofs] = self._signs * velocities[2]
        mujoco.mj_kinematics(self.model, self.data)  # places the ground

    # ---- the ground and contacts -------------------------------------------------------------------------------------

    def ground_heights(self, places: np.ndarray) -> np.ndarray:
        """Return heights of the ground at x and y of places, -inf where there is none. Shapes: (n, 2), (n,) [m]."""
        model, data, down = self.model, self.data, np.array([0.0, 0.0, -1.0])
        heights = np.full(len(places), -np.inf)
        for i, (x, y) in enumerate(places):
            above = np.array([x, y, _ABOVE])
            for geom in self._grounds.tolist():
                kind = model.geom_type[geom]
                if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
                    depth = mujoco.mj_rayHfield(model, data, geom, above, down)
                elif kind == mujoco.mjtGeom.mjGEOM_MESH:
                    depth = mujoco.mj_rayMesh(model, data, geom, above, down)
                else:
                    is_plane = kind == mujoco.mjtGeom.mjGEOM_PLANE  # which is infinite; its size is only drawn
                    size = np.zeros(3) if is_plane else model.geom_size[geom]
                    depth = mujoco.mju_rayGeom(data.geom_xpos[geom], data.geom_xmat[geom], size, above, down, kind)
                if depth >= 0.0:
                    heights[i] = max(heights[i], _ABOVE - depth)
        return heights

    def height(self) -> float:
        """Return the height of the trunk's origin above the ground; infinite where there is none [m]."""
        return float(self.position[2] - self.ground_heights(self.position[np.newaxis, :2])[0])

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

    def _find_joints(self, description: dict[str, Any]) -> None:
        """Find the policy's joints and their motors; a UserError lists what is missing."""
        model, order = self.model, description["joint_order"]
        ids, motors = joints_and_motors(model, order)
        axes = [description["joints"][name]["axis"] for name in order]
        cosines = (mjcf.joint_axes(model)[ids] * axes).sum(axis=1)
        self._qpos, self._dofs, self._motors = model.jnt_qposadr[ids], model.jnt_dofadr[ids], np.array(motors)
        self._signs = np.where(cosines < -PARALLEL, -1.0, 1.0)  # of the file's axes, as seen from the policy's
        self._limits = np.sort(mjcf.joint_limits(model)[ids].T * self._signs, axis=0)  # [rad] about the policy's axes
        self._torque_per_control = self._signs * [mjcf.torque_per_control(model, motor) for motor in motors]
        self._cosines = cosines

    def _joint_notes(self) -> Iterator[str]:
        """Yield a note on everything that differs from the training, with the joints that it concerns."""
        description, cosines = self._description, self._cosines
        mass, trained_mass = float(self.model.body_mass.sum()), description["robot"]["mass"]
        if not np.isclose(mass, trained_mass, rtol=MASS_TOLERANCE):
            yield f"mass: {mass:.3f} kg here, {trained_mass:.3f} kg in the training"
        different = defaultdict[str, list[str]](list)
        for i, name in enumerate(description["joint_order"]):
            trained, (low, high) = description["joints"][name], self._limits[:, i]
            if cosines[i] < -PARALLEL:
                different["axes: those of the MJCF point the other way; angles and torques are negated"].append(name)
            elif cosines[i] <= PARALLEL:
                different["axes: those of the MJCF are not the policy's"].append(name)
            if not low - 1e-6 <= description["nominal_pose"][name] <= high + 1e-6:
                note = "nominal pose: beyond the joint limits of the MJCF, where episodes start instead"
                different[note].append(name)
            for field in ("damping", "armature", "frictionloss"):
                own = float(getattr(self.model, f"dof_{field}")[self._dofs[i]])
                if not np.isclose(own, trained[field], rtol=1e-4, atol=1e-9):
                    different[f"{field} of joints: {own:g} here, {trained[field]:g} in the training"].append(name)
            own_limits = np.sort(self._signs[i] * np.array(mjcf.torque_range(self.model, self._motors[i])))
            limits = description["torque_limits"][name]
            if not np.allclose(own_limits, limits, rtol=1e-4):
                here, there = ("{:g} to {:g} N m".format(*each) for each in (own_limits, limits))
                different[f"motor limits: the MJCF has {here}, policy.yaml {there}; the tighter ones act"].append(name)
        for note, names in different.items():
            yield f"{note} ({', '.join(names) if len(names) < len(cosines) else 'all joints'})"

    def _find_geoms(self, ends_on_contact_of: list[str], collided: bool) -> None:
        """Find the ground and the geoms whose contact ends an episode: by parts of names, else those of the trunk.

        What the robot may touch is the ground and, if they ``collided`` in training, its own parts.
        """
        model = self.model
        self._is_ground = model.body_weldid[model.geom_bodyid] == 0
        (self._grounds,) = np.nonzero(self._is_ground & (model.geom_contype | model.geom_conaffinity != 0))
        self._is_felt = self._is_ground | (collided & (model.body_rootid[model.geom_bodyid] == self.trunk))
        names = [model.geom(i).name or model.body(model.geom_bodyid[i]).name for i in range(model.ngeom)]
        matching = {part: np.array([part in name for name in names]) & ~self._is_ground for part in ends_on_contact_of}
        self._is_ending = np.any([np.zeros(model.ngeom, bool), *matching.values()], axis=0)
        missing = ", ".join(part for part, geoms in matching.items() if not geoms.any())
        if missing and self._is_ending.any():
            self._notes.append(f"no geom's name contains {missing}: it ends no episode")
        elif missing:
            trunk = model.body(self.trunk).name
            self._notes.append(f"no geom's name contains {missing}: those of '{trunk}' end an episode")
            self._is_ending = model.geom_bodyid == self.trunk
