"""Where a robot is drawn that walks beside another one, in a simulation of its own."""

from __future__ import annotations

import numpy as np

SIDE = 0.8  # distance between the two at the start, to the right of the first one [m]
FARTHEST = 2.0  # distance at which the second one is put beside the first one again [m]


class Lane:
    """Puts the second robot beside the first one; from there on both go where they walk, until they are far apart."""

    def __init__(self) -> None:
        """Start without a place: that is found with the first robots."""
        self._turn, self._from, self._to = 0.0, np.zeros(2), np.full(2, np.inf)

    def place(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the second robot's positions in the world of the first one; all are like rows of ``sim.qpos``."""
        placed = self._moved(second)
        if not np.hypot(*(placed[:2] - first[:2])) < FARTHEST:
            heading = heading_of(first)
            self._turn, self._from = heading - heading_of(second), second[:2].astype(float)
            self._to = first[:2] + SIDE * np.array([np.sin(heading), -np.cos(heading)])
            placed = self._moved(second)
        return placed

    def _moved(self, qpos: np.ndarray) -> np.ndarray:
        """Return positions turned about the vertical and moved."""
        moved = qpos.copy()
        cos, sin = np.cos(self._turn), np.sin(self._turn)
        moved[:2] = np.array([[cos, -sin], [sin, cos]]) @ (qpos[:2] - self._from) + self._to
        c, s = np.cos(0.5 * self._turn), np.sin(0.5 * self._turn)
        w, x, y, z = qpos[3:7]
        moved[3:7] = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
        return moved


def heading_of(qpos: np.ndarray) -> float:
    """Return the direction of a robot's front about the vertical [rad]."""
    w, x, y, z = qpos[3:7]
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
