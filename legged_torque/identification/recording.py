"""What a log says of a robot that hangs: commands and measurements of all joints at equal times."""

from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from legged_torque.utils.errors import UserError

COMMAND = ("tau", "q", "dq", "kp", "kd")
SHORTEST = 5.0  # [s] of motion
MAX_SWING = 0.05  # [rad] of the trunk, with which 5% of the weight turn


@dataclass(frozen=True)
class Recording:
    """A motion in the air.

    Attributes:
        joint_order: Names of the joints.
        period: Time between two ticks [s].
        quaternion: Orientation of the trunk (w, x, y, z), which does not move.
        commands: What was sent in each tick: tau [N m], q [rad], dq [rad/s], kp [N m/rad], kd [N m s/rad].
            Shape: (ticks, 5, joints).
        measured: Positions [rad] and velocities [rad/s] before that, NaN where none came. Shape: (ticks, 2, joints).
    """

    joint_order: list[str]
    period: float
    quaternion: np.ndarray
    commands: np.ndarray
    measured: np.ndarray


def read_recording(log: Any) -> Recording:
    """Return the longest part of a :class:`~legged_torque.runtime.log.RecordedLog` in which a policy or a chirp acts.

    A tick is where it was due, and repeats the one before if it was late by more than half a period. A UserError if
    that part is too short, begins without a state, or the trunk moves.
    """
    parts = [list(ticks) for mode, ticks in groupby(log.ticks(), lambda tick: tick[3]["mode"]) if mode == "policy"]
    ticks = max(parts, key=len, default=[])
    if len(ticks) * log.period < SHORTEST:
        raise UserError(f"the log has {len(ticks) * log.period:.1f} s of a policy or chirp; {SHORTEST:g} s are needed")
    times, states, sent, _ = zip(*ticks, strict=True)
    times = times if log.keeps_time else log.period * np.arange(len(ticks))  # such a robot waits for late ticks
    if states[0] is None:
        raise UserError("the log has no state of the robot where the motion begins")
    count = round((times[-1] - times[0]) / log.period) + 1
    rows = np.searchsorted(times, times[0] + log.period * (0.5 + np.arange(count))) - 1
    nothing = np.full((2, len(log.joint_order)), np.nan)
    said = [nothing if state is None else (state.joint_positions, state.joint_velocities) for state in states]
    measured = np.where(np.diff(rows, prepend=-1)[:, None, None], np.array(said)[rows], np.nan)
    commands = np.array([[getattr(command, name) for name in COMMAND] for command in sent])[rows]
    quaternion = held([state.quaternion for state in states if state is not None])
    return Recording(log.joint_order, log.period, quaternion, commands, measured)


def held(quaternions: list[np.ndarray]) -> np.ndarray:
    """Return the mean orientation (4,); a UserError if the direction of gravity, seen from the trunk, moves."""
    each = np.array(quaternions) * np.where(np.dot(quaternions, quaternions[0]) < 0.0, -1.0, 1.0)[:, None]
    w, x, y, z = (each / np.linalg.norm(each, axis=1, keepdims=True)).T
    down = np.stack([x * z - w * y, y * z + w * x, 0.5 - x * x - y * y], axis=1)
    swing = 2.0 * float(np.linalg.norm(down - down.mean(axis=0), axis=1).max())
    if not swing <= MAX_SWING:
        raise UserError(f"the trunk swings by {swing:.2f} rad in the log, {MAX_SWING:g} are allowed: hold it firmly")
    return each.mean(axis=0) / np.linalg.norm(each.mean(axis=0))
