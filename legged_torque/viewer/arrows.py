"""Arrows of velocities in a scene of MuJoCo: green is commanded, blue is actual. Needs neither torch nor Warp."""

from __future__ import annotations

import mujoco
import numpy as np

COMMAND_COLOR, VELOCITY_COLOR = (0.1, 0.8, 0.2, 0.9), (0.1, 0.4, 1.0, 0.9)
LENGTH = 0.5  # of the arrow of 1 m/s [m]


def add_velocities(
    scene: mujoco.MjvScene, data: mujoco.MjData, trunk: int, command: np.ndarray, velocity: np.ndarray, size: float
) -> None:
    """Draw velocities above the trunk of a robot of a :func:`~legged_torque.viewer.framing.size_of`.

    ``command`` and ``velocity`` begin with v_x and v_y in the trunk's frame [m/s]; ``trunk`` is its body.
    """
    rotation = data.xmat[trunk].reshape(3, 3)
    for vector, color, height in ((command, COMMAND_COLOR, 0.24), (velocity, VELOCITY_COLOR, 0.2)):
        start = data.xpos[trunk] + np.array([0.0, 0.0, size * height])
        _add_arrow(scene, start, rotation @ [vector[0], vector[1], 0.0], color)


def _add_arrow(scene: mujoco.MjvScene, start: np.ndarray, vector: np.ndarray, color: tuple[float, ...]) -> None:
    """Draw a velocity [m/s], if there is room."""
    if np.linalg.norm(vector) < 1e-3 or scene.ngeom >= scene.maxgeom:
        return
    geom, kind = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_ARROW
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(color, np.float32))
    mujoco.mjv_connector(geom, kind, 0.012, start, start + LENGTH * vector)
    scene.ngeom += 1
