"""Poses of robots that are drawn but not simulated there: the ghost, and a robot of another simulation."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

import numpy as np
import torch

from legged_torque.utils.math import yaw
from legged_torque.viewer.snapshot import Snapshot

GHOST_SECONDS = 1.0  # for which the ghost has followed the commands
SIDE = 0.8  # distance of the second robot at the start, to the right of the first one [m]
FARTHEST = 2.0  # distance at which the second robot returns to the side of the first one [m]


def heading(qpos: np.ndarray) -> float:
    """Return a robot's angle about the world's z axis [rad], as its task computes it. Shape: (nq,)."""
    return yaw(torch.from_numpy(qpos[3:7])).item()


def commanded_pose(past: Sequence[Snapshot], dt: float) -> np.ndarray:
    """Return where the followed robot would be if it had followed its commands for a second. Shape: (nq,).

    The pose is upright, with the present height and joints. A younger episode counts from its start. ``past`` are the
    last steps, the present one included, of ``dt`` [s] each.
    """
    now = past[-1]
    steps = min(round(GHOST_SECONDS / dt), len(past) - 1, now.age)
    pose, start = now.qpos[now.world].copy(), past[-1 - steps].qpos[now.world]
    place, angle = complex(*start[:2]), heading(start)
    for snapshot in past[len(past) - steps :]:
        v_x, v_y, yaw_rate = snapshot.commands[now.world]
        place += dt * complex(v_x, v_y) * cmath.rect(1.0, angle + 0.5 * yaw_rate * dt)
        angle += yaw_rate * dt
    pose[:2], pose[3:7] = (place.real, place.imag), (math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle))
    return pose


class SideBySide:
    """Places a second robot at the side of a first one. Both walk freely from there until they are far apart."""

    def __init__(self) -> None:
        """Start without a place; the first robots determine it."""
        self._angle, self._shift = 0.0, complex(math.inf)  # turn and then shift of the second robot's world

    def place(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the positions of the second robot in the world of the first one. Shape: (nq,) each."""
        to, of = complex(*first[:2]), complex(*second[:2])
        if not abs(of * cmath.rect(1.0, self._angle) + self._shift - to) < FARTHEST:
            self._angle = heading(first) - heading(second)
            side = to + cmath.rect(SIDE, heading(first) - 0.5 * math.pi)
            self._shift = side - of * cmath.rect(1.0, self._angle)
        place, (w, x, y, z) = of * cmath.rect(1.0, self._angle) + self._shift, second[3:7]
        cos, sin = math.cos(0.5 * self._angle), math.sin(0.5 * self._angle)
        quat = (cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w)
        return np.array([place.real, place.imag, second[2], *quat, *second[7:]])
