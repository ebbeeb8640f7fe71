"""The nominal pose of a robot, the height of its trunk, and gains that hold it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.minimize import least_squares

from legged_torque.importer.legs import PITCHING, Leg, lowest_point, zero_pose
from legged_torque.importer.source import Source

BANDWIDTH = 4.0  # natural frequency of a joint under its gains, with the inertia of the leg below it [Hz]
DAMPING_RATIO = 0.5  # of the same
SAG = 0.1  # largest deflection of a joint under the robot's weight [rad]
TIPPING = 2.0  # multiple of the stiffness below which a robot with level trunk tips over its feet, shared by its legs
BALANCING = 5  # iterations in which both feet of a biped are moved below its center of mass
MISSED = 0.02  # distance by which a foot may miss its place [m]
CROUCH = {False: 0.75, True: 0.95}  # height of hips over feet as a share of stretched legs; without and with soles
BEND = {False: (0.8, -1.6, 0.0), True: (-0.4, 0.8, 0.0)}
"""First angles of thigh, knee and ankle about y, for knees that bend backwards and forwards [rad]."""
UNDECIDED = 0.3  # middle of a knee's range, either way, up to which it bends as the kind of leg suggests [rad]
LEVELING = 0.3  # weight of a sole's inclination against its distance [m/rad]
ARMATURE = 0.01 / 33.5  # rotor inertia per torque of the A1, for joints without one [kg m^2 per N m]


@dataclass
class Stance:
    """The nominal pose and what follows from it; lists are by joint."""

    angles: np.ndarray  # [rad]
    height: float  # [m] of the trunk's origin over the ground
    armature: np.ndarray  # [kg m^2]
    stiffness: np.ndarray  # [N m/rad]
    damping: np.ndarray  # [N m s/rad]


def find_stance(source: Source, legs: list[Leg], ranges: np.ndarray, torques: np.ndarray) -> Stance:
    """Return how a robot stands: in its file's keyframe, otherwise by inverse kinematics. Adds notes.

    ``ranges`` [rad] and ``torques`` [N m] are the joints' limits. Shapes: (joints, 2), (joints,).
    """
    model = source.model
    angles = _nominal_pose(source, legs, ranges)
    data = zero_pose(model, angles)
    armature = model.dof_armature[6:].copy()
    bare = armature <= 0
    armature[bare] = (ARMATURE * torques)[bare]
    if bare.any():
        source.notes.append(
            f"{bare.sum()} joints without rotor inertia (armature): assumed 0.01 kg m^2 per 33.5 N m, as on the A1; "
            "put the motor's own there if you know it"
        )
    mujoco.mj_crb(model, data)
    matrix = np.zeros((model.nv, model.nv))
    for row, unit in zip(matrix, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    inertia = np.diag(matrix)[6:] - model.dof_armature[6:] + armature  # about each joint, of all that it moves
    mujoco.mj_comVel(model, data)
    mujoco.mj_rne(model, data, 0, data.qfrc_bias)
    holding, jac = data.qfrc_bias.copy(), np.zeros((3, model.nv))  # torques of a robot that stands evenly on all feet
    lows = [lowest_point(data, leg.bodies[-1], leg.foot) for leg in legs]
    for leg, low in zip(legs, lows, strict=True):
        mujoco.mj_jac(model, data, jac, None, low, leg.bodies[-1])
        holding -= jac.T @ np.array([0, 0, source.weight / len(legs)])
    height = -float(np.mean([low[2] for low in lows]))
    stiffness = np.maximum((2 * np.pi * BANDWIDTH) ** 2 * inertia, np.abs(holding[6:]) / SAG)
    for leg in legs:
        joints = model.body_jntadr[leg.bodies] - 1
        stiffness[joints] = np.maximum(stiffness[joints], TIPPING * source.weight * height / len(legs))
    damping = 2 * DAMPING_RATIO * np.sqrt(stiffness * inertia)
    return Stance(angles, height, armature, stiffness, damping)


def _nominal_pose(source: Source, legs: list[Leg], ranges: np.ndarray) -> np.ndarray:
    """Return the angles of the file's keyframe, otherwise those of inverse kinematics [rad]. Adds notes."""
    model = source.model
    if source.pose is not None:
        angles = source.pose
        source.notes.append("nominal pose: the keyframe of the file")
    else:
        angles = np.clip(np.zeros(len(source.joints)), ranges[:, 0], ranges[:, 1])
        ahead = 0.0
        for _ in range(BALANCING if len(legs) == 2 else 1):
            missed = {leg.name: _bend(model, leg, angles, ranges, ahead) for leg in legs}
            data = zero_pose(model, angles)
            feet = [lowest_point(data, leg.bodies[-1], leg.foot)[0] for leg in legs]
            ahead += float(data.subtree_com[1][0] - np.mean(feet))
        share = CROUCH[legs[0].has_sole]
        source.notes.append(
            f"nominal pose: inverse kinematics, feet below {'the center of mass' if len(legs) == 2 else 'hips'}, "
            f"legs {share:.0%} stretched"
        )
        far = (f"{name} by {miss:.2f} m" for name, miss in missed.items() if miss > MISSED)
        source.notes.on(far, "within the limits of joints, feet do not get there")
    outside = (angles < ranges[:, 0]) | (angles > ranges[:, 1])
    source.notes.on(source.which(outside), "the nominal pose was beyond the limits and is moved inside")
    low, high = np.ceil(1e3 * ranges[:, 0]) / 1e3, np.floor(1e3 * ranges[:, 1]) / 1e3
    return np.clip(angles.round(3), low, high)  # rounded as in the settings, inside the limits


def _bend(model: mujoco.MjModel, leg: Leg, angles: np.ndarray, ranges: np.ndarray, ahead: float) -> float:
    """Bend a leg until its foot is below its hip, or ``ahead`` of that [m], soles being level.

    The trunk is at the origin. Writes the leg's angles. Returns by how much the foot misses its place [m].
    """
    data, body = zero_pose(model), leg.bodies[-1]
    joints = model.body_jntadr[leg.bodies]
    pitch = joints[np.abs(data.xaxis[joints, 1]) > PITCHING]
    if not pitch.size:
        return 0.0
    foot, level = lowest_point(data, body, leg.foot), data.xmat[body].reshape(3, 3).copy()
    chain = [*data.xanchor[joints[list(joints).index(pitch[0]) :]], foot]
    links = np.diff([place[::2] for place in chain], axis=0)  # in the plane of x and z
    lengths = CROUCH[leg.has_sole] * np.linalg.norm(links, axis=1)
    if leg.has_sole:
        lengths[-1] = abs(links[-1][1])  # feet stay level
    goal = chain[0] + np.array([ahead, 0.0, -lengths.sum()])
    if leg.has_sole or len(pitch) == len(joints):  # which keeps its feet to the side of its hips
        goal[1] = foot[1]
    forwards, signs = leg.has_sole, np.sign(data.xaxis[pitch, 1])
    if len(pitch) > 1:  # knees bend to where they have more room
        middle = ranges[pitch[1] - 1].mean() * signs[1]
        forwards = middle > UNDECIDED or (forwards and middle > -UNDECIDED)
    angles[pitch[:3] - 1] = [angle * sign for angle, sign in zip(BEND[forwards], signs, strict=False)]

    def misses(columns: np.ndarray) -> np.ndarray:
        """Return by how much the foot misses its place [m] and is not level, for each column of angles."""
        rows = []
        for q in columns.reshape(len(joints), -1).T:
            angles[joints - 1] = q
            data = zero_pose(model, angles)
            turned = data.xmat[body].reshape(3, 3) @ level.T
            lean = 0.5 * (turned - turned.T)[[2, 0, 1], [1, 2, 0]]
            rows.append([*(lowest_point(data, body, leg.foot) - goal), *(LEVELING * leg.has_sole * lean)])
        return np.transpose(rows)

    low, high = ranges[joints - 1].T
    start = np.clip(angles[joints - 1], low, high)
    found, _ = least_squares(start, misses, bounds=(low, high), verbose=0)
    return float(np.linalg.norm(misses(found)[:3]))
