"""The nominal pose of a robot, the height of its trunk, and gains that hold it."""

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.minimize import least_squares

from legged_torque.importer.legs import PARALLEL, Leg, pitch_axis
from legged_torque.importer.shapes import Shape, lowest_point
from legged_torque.importer.source import Source
from legged_torque.utils.mjcf import mass_matrix, zero_pose

TIPPING = 2.3  # stiffness of legs, as a multiple of that below which a level trunk tips over its feet: weight times
# height, shared by the legs. The robots that come along have 1.3 to 2.2, the ankles of the G1 0.3
SAG = 0.2  # largest deflection of a joint under the robot's weight [rad]
RETARDATION = 0.025  # damping per stiffness, as of the quadrupeds that come along [s]
STABLE = 0.5  # damping per inertia and physics step, up to which torques of the step before still damp
STEP = 0.005  # physics step [s]
BANDWIDTH = 4.0  # natural frequency of joints off the legs, with the inertia that they move [Hz]
LEAST_LOAD = 0.08  # of a straight leg as a share of weight times height per leg, for the scale of torques
MOST_UNEVEN = 0.2  # difference of the heights of feet in a keyframe in which it stands, as a share of the trunk's
SPREAD = (0.5, 1.0, 1.5)  # shares of the nominal angles at which episodes may start, see domain_rand
GAP = 0.02  # between the ground and a robot at the start of an episode [m]
BALANCING = 5  # iterations in which feet are moved below the center of mass
MISSED = 0.02  # distance by which a foot may miss its place [m]
CROUCH = {False: 0.8, True: 0.95}  # height of hips over feet as a share of stretched legs; without and with soles
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
    drop: float  # the same at the start of an episode
    load: float  # largest torque of a leg's joint in it [N m]
    armature: np.ndarray  # [kg m^2]
    stiffness: np.ndarray  # [N m/rad]
    damping: np.ndarray  # [N m s/rad]


def find_stance(
    source: Source, legs: list[Leg], shapes: dict[int, list[Shape]], ranges: np.ndarray, torques: np.ndarray
) -> Stance:
    """Return how a robot stands: in a keyframe of its file, otherwise by inverse kinematics. Adds notes.

    ``ranges`` [rad] and ``torques`` [N m] are the joints' limits. Shapes: (joints, 2), (joints,).
    """
    model = source.model
    angles = _nominal_pose(source, legs, shapes, ranges)
    data = zero_pose(model, angles)
    armature = model.dof_armature[6:].copy()
    bare = armature <= 0
    armature[bare] = (ARMATURE * torques)[bare]
    if bare.any():
        source.notes.append(
            f"{bare.sum()} joints without rotor inertia (armature): assumed 0.01 kg m^2 per 33.5 N m, as on the A1; "
            "put the motor's own there if you know it"
        )
    matrix = mass_matrix(model, data)
    inertia = np.diag(matrix)[6:] - model.dof_armature[6:] + armature  # about each joint, of all that it moves
    height, holding, stiff = _standing(source, legs, data)
    started = [zero_pose(model, np.clip(share * angles, ranges[:, 0], ranges[:, 1])) for share in SPREAD]
    drop = GAP - min(lowest_point(each, leg.bodies[-1], leg.foot)[2] for each in started for leg in legs)
    stiffness = (2 * np.pi * BANDWIDTH) ** 2 * inertia
    moving = np.concatenate([model.body_jntadr[leg.bodies] - 1 for leg in legs])
    stiffness[moving] = stiff[moving]
    matrix[range(6, model.nv), range(6, model.nv)] += armature - model.dof_armature[6:]
    freely = 1.0 / np.diag(np.linalg.inv(matrix))[6:]  # inertia about each joint while all others give way
    damping = np.minimum(RETARDATION * stiffness, STABLE * freely / STEP)
    load = max(np.abs(holding[moving]).max(), LEAST_LOAD * source.weight * height / len(legs))
    return Stance(angles, height, drop, float(load), armature, stiffness, damping)


def _standing(source: Source, legs: list[Leg], data: mujoco.MjData) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the height of the trunk of a robot that stands evenly on all feet, and torques and stiffness for that.

    Torques [N m] hold the joints; stiffness [N m/rad] is that of legs. Shapes: (joints,).
    """
    model, jac = source.model, np.zeros((3, source.model.nv))
    mujoco.mj_comVel(model, data)
    mujoco.mj_rne(model, data, 0, data.qfrc_bias)
    mujoco.mj_passive(model, data)
    holding = data.qfrc_bias - data.qfrc_spring
    lows = [lowest_point(data, leg.bodies[-1], leg.foot) for leg in legs]
    for leg, low in zip(legs, lows, strict=True):
        mujoco.mj_jac(model, data, jac, None, low, leg.bodies[-1])
        holding -= jac.T @ np.array([0, 0, source.weight / len(legs)])
    height = -float(np.mean([low[2] for low in lows]))
    usual = TIPPING * source.weight * height / len(legs)
    return height, holding[6:], np.maximum(usual, np.abs(holding[6:]) / SAG)


def _why_lying(source: Source, legs: list[Leg], shapes: dict[int, list[Shape]], angles: np.ndarray) -> str:
    """Return why a robot cannot stand on its feet with these angles [rad]; empty if it can."""
    _, holding, stiffness = _standing(source, legs, zero_pose(source.model, angles))
    data = zero_pose(source.model, angles - holding / stiffness)  # under its weight
    feet = np.array([lowest_point(data, leg.bodies[-1], leg.foot) for leg in legs])
    level = feet[:, 2].mean()
    if np.ptp(feet[:, 2]) > MOST_UNEVEN * -level:
        return "its feet are not level"
    for body, found in shapes.items():
        if any(lowest_point(data, body, shape)[2] < level for shape in found):
            return f"'{source.model.body(body).name}' is lower than its feet"
    return ""


def _nominal_pose(source: Source, legs: list[Leg], shapes: dict[int, list[Shape]], ranges: np.ndarray) -> np.ndarray:
    """Return the angles of the first keyframe in which it stands, otherwise of inverse kinematics [rad]. Adds notes."""
    model = source.model
    reasons = {name: _why_lying(source, legs, shapes, pose) for name, pose in source.poses.items()}
    standing = [name for name, reason in reasons.items() if not reason]
    lying = (f"'{name}', where {reason}" for name, reason in reasons.items() if reason and not standing)
    source.notes.on(lying, "not the nominal pose: the keyframe")
    if standing:
        angles = source.poses[standing[0]]
        source.notes.append(f"nominal pose: the keyframe '{standing[0]}' of the file")
    else:
        angles = np.clip(np.zeros(len(source.joints)), ranges[:, 0], ranges[:, 1])
        ahead = 0.0
        for _ in range(BALANCING):
            missed = {leg.name: _bend(model, leg, angles, ranges, ahead) for leg in legs}
            _, holding, stiffness = _standing(source, legs, zero_pose(model, angles))
            data = zero_pose(model, angles - holding / stiffness)  # under its weight
            feet = [lowest_point(data, leg.bodies[-1], leg.foot)[0] for leg in legs]
            ahead += float(data.subtree_com[1][0] - np.mean(feet))
        stretched = f"legs {CROUCH[legs[0].has_sole]:.0%} stretched"
        source.notes.append(f"nominal pose: inverse kinematics, feet below the center of mass, {stretched}")
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
    axis = pitch_axis(data.xaxis[joints])
    pitch = joints[np.abs(data.xaxis[joints] @ axis) > PARALLEL]
    plane = np.array([np.cross(axis, [0.0, 0.0, 1.0]), [0.0, 0.0, 1.0]])  # in which the leg bends
    foot, level = lowest_point(data, body, leg.foot), data.xmat[body].reshape(3, 3).copy()
    chain = [*data.xanchor[joints[list(joints).index(pitch[0]) :]], foot]
    links = np.diff(chain @ plane.T, axis=0)
    lengths = CROUCH[leg.has_sole] * np.linalg.norm(links, axis=1)
    if leg.has_sole:
        lengths[-1] = abs(links[-1][1])  # feet stay level
    goal = chain[0] + np.array([ahead, 0.0, -lengths.sum()])
    if leg.has_sole or len(pitch) == len(joints):  # which keeps its feet to the side of its hips
        goal += axis * ((foot - goal) @ axis)
    forwards, signs = leg.has_sole, np.sign(data.xaxis[pitch] @ axis)
    if len(pitch) > 1:  # knees bend to where they have more room
        middle = ranges[pitch[1] - 1].mean() * signs[1]
        forwards = middle > UNDECIDED or (forwards and middle > -UNDECIDED)
    angles[pitch[:3] - 1] = [angle * sign for angle, sign in zip(BEND[forwards], signs, strict=False)]

    def misses(columns: np.ndarray) -> np.ndarray:
        """Return by how much the foot misses its place [m] and is not level, for each column of angles."""
        rows = []
        for q in columns.reshape(len(joints), -1).T:
            angles[joints - 1] = q
            data.qpos[7:] = angles
            mujoco.mj_kinematics(model, data)
            turned = data.xmat[body].reshape(3, 3) @ level.T
            lean = 0.5 * (turned - turned.T)[[2, 0, 1], [1, 2, 0]]
            rows.append([*(lowest_point(data, body, leg.foot) - goal), *(LEVELING * leg.has_sole * lean)])
        return np.transpose(rows)

    low, high = ranges[joints - 1].T
    start = np.clip(angles[joints - 1], low, high)
    found, _ = least_squares(start, misses, bounds=(low, high), verbose=0)
    return float(np.linalg.norm(misses(found)[:3]))
