"""How a robot stands: its nominal pose, the height of its trunk, and gains that hold it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from legged_torque.importer.legs import Leg, world_shape, zero_pose
from legged_torque.importer.source import GRAVITY, Source

BANDWIDTH = 4.0  # [Hz] natural frequency of a joint under its gains, with the inertia of the leg below it
DAMPING_RATIO = 0.5  # of the same
SAG = 0.1  # [rad] by which a joint may give way under the robot's weight
TIPPING = 2.0  # times the stiffness below which a robot with level trunk tips over its feet, shared by its legs
BALANCING = 5  # times that both feet of a robot are moved below its center of mass
MISSED = 0.02  # [m] by which a foot may miss its place
CROUCH = {False: 0.75, True: 0.95}  # height of hips over feet in stance, of stretched legs'; without and with ankles
BEND = {False: (0.8, -1.6), True: (-0.4, 0.8)}  # [rad] angles of thigh and knee about y to start from, likewise
ARMATURE = 0.01 / 33.5  # [kg m^2 per N m] rotor's inertia per torque, that of the A1, where a file has none


@dataclass
class Stance:
    """The nominal pose and what follows from it; lists are by joint."""

    angles: np.ndarray  # [rad]
    height: float  # [m] of the trunk's origin over the ground
    armature: np.ndarray  # [kg m^2]
    stiffness: np.ndarray  # [N m/rad]
    damping: np.ndarray  # [N m s/rad]
    holding: np.ndarray  # [N m] torques that hold the weight, shared evenly by the feet


def find_stance(source: Source, legs: list[Leg], ranges: np.ndarray, torques: np.ndarray) -> Stance:
    """Return how a robot stands: in its file's keyframe, otherwise as inverse kinematics finds. Adds notes.

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
    lows = [world_shape(data, leg.bodies[-1], leg.foot) for leg in legs]
    inertia, holding = _inertias(model, data) + armature, _holding_torques(model, data, legs, lows)
    height = -float(np.mean([low[2] for low in lows]))
    stiffness = np.maximum((2 * np.pi * BANDWIDTH) ** 2 * inertia, np.abs(holding) / SAG)
    weight = GRAVITY * float(model.body_mass.sum())
    for leg in legs:
        joints = model.body_jntadr[leg.bodies] - 1
        stiffness[joints] = np.maximum(stiffness[joints], TIPPING * weight * height / len(legs))
    damping = 2 * DAMPING_RATIO * np.sqrt(stiffness * inertia)
    return Stance(angles, height, armature, stiffness, damping, holding)


def _nominal_pose(source: Source, legs: list[Leg], ranges: np.ndarray) -> np.ndarray:
    """Return the angles [rad] of the file's keyframe, otherwise those that inverse kinematics finds. Adds notes."""
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
            feet = [world_shape(data, leg.bodies[-1], leg.foot)[0] for leg in legs]
            ahead += float(data.subtree_com[1][0] - np.mean(feet))
        share = CROUCH[legs[0].is_walking_on_soles]
        source.notes.append(
            f"nominal pose: inverse kinematics, feet below {'the center of mass' if len(legs) == 2 else 'hips'}, "
            f"legs {share:.0%} stretched"
        )
        far = ", ".join(f"{name} by {miss:.2f} m" for name, miss in missed.items() if miss > MISSED)
        if far:
            source.notes.append(f"within the limits of joints, feet do not get there: {far}")
    outside = [name for name, q, (low, high) in zip(source.joints, angles, ranges, strict=True) if not low <= q <= high]
    if outside:
        source.notes.append(f"the nominal pose was beyond the limits of {', '.join(outside)} and is moved inside")
    low, high = np.ceil(1e3 * ranges[:, 0]) / 1e3, np.floor(1e3 * ranges[:, 1]) / 1e3
    return np.clip(angles.round(3), low, high)  # as the settings have them, inside the limits


def _bend(model: mujoco.MjModel, leg: Leg, angles: np.ndarray, ranges: np.ndarray, ahead: float) -> float:
    """Bend a leg until its foot is below its hip, or ``ahead`` of that [m], and return by how much it missed [m].

    Writes the angles of its joints.
    """
    data = zero_pose(model)
    joints = np.array([model.body_jntadr[body] for body in leg.bodies])
    places = [*data.xanchor[joints], world_shape(data, leg.bodies[-1], leg.foot)]
    pitch = [i for i, joint in enumerate(joints) if abs(data.xaxis[joint][1]) > 0.7]
    if not pitch:
        return 0.0
    links = np.diff([place[::2] for place in places[pitch[0] :]], axis=0)  # in the plane of x and z
    lengths = CROUCH[leg.is_walking_on_soles] * np.linalg.norm(links, axis=1)
    if leg.is_walking_on_soles:
        lengths[-1] = abs(links[-1][1])  # feet stay flat
    goal = places[pitch[0]] + np.array([ahead, 0, -lengths.sum()])
    if leg.is_walking_on_soles or len(pitch) == len(joints):  # feet stay beside hips
        goal[1] = places[-1][1]
    start, (low, high) = angles[joints - 1], ranges[joints - 1].T
    knee = joints[pitch[1]] if len(pitch) > 1 else None
    forwards = leg.is_walking_on_soles
    if knee is not None:  # knees bend to the side where there is more room
        middle = np.clip(ranges[knee - 1].mean(), -1.6, 1.6) * np.sign(data.xaxis[knee][1])
        forwards = middle > 0.3 or (forwards and middle > -0.3)
    for place, angle in zip(pitch, (*BEND[forwards], 0.0), strict=False):
        start[place] = angle * np.sign(data.xaxis[joints[place]][1])
    flat = data.xmat[leg.bodies[-1]].reshape(3, 3).copy()
    q = np.clip(start, low, high)
    for _ in range(200):
        angles[joints - 1] = q
        data = zero_pose(model, angles)
        foot = world_shape(data, leg.bodies[-1], leg.foot)
        jacp, jacr = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacp, jacr, foot, leg.bodies[-1])
        rows, error = jacp[:, joints + 5], goal - foot
        if leg.is_walking_on_soles:
            turned = flat @ data.xmat[leg.bodies[-1]].reshape(3, 3).T
            lean = 0.5 * np.array(
                [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
            )
            rows, error = np.vstack([rows, 0.3 * jacr[:, joints + 5]]), np.concatenate([error, 0.3 * lean])
        step = rows.T @ np.linalg.solve(rows @ rows.T + 1e-4 * np.eye(len(rows)), error)
        before, q = q, np.clip(q + step * 0.2 / max(0.2, np.abs(step).max()), low, high)
        if np.abs(q - before).max() < 1e-5:
            break
    angles[joints - 1] = q
    return float(np.linalg.norm(goal - foot))


def _inertias(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the inertia [kg m^2] about each joint of what it moves, without armature."""
    mujoco.mj_crb(model, data)
    matrix = np.zeros((model.nv, model.nv))
    for row, unit in zip(matrix, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    return np.diag(matrix)[6:] - model.dof_armature[6:]


def _holding_torques(model: mujoco.MjModel, data: mujoco.MjData, legs: list[Leg], lows: list[np.ndarray]) -> np.ndarray:
    """Return the torques [N m] that hold the robot still, the ground pushing up evenly on all feet."""
    mujoco.mj_comVel(model, data)
    mujoco.mj_rne(model, data, 0, data.qfrc_bias)
    torques = data.qfrc_bias.copy()
    force = np.array([0, 0, GRAVITY * model.body_mass.sum() / len(legs)])
    for leg, low in zip(legs, lows, strict=True):
        jac = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jac, None, low, leg.bodies[-1])
        torques -= jac.T @ force
    return torques[6:]
