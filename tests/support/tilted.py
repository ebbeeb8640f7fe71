"""Tilted trunks."""

import mujoco
import numpy as np


def tilted(yaw, angle=1.0):
    """The quaternion of a trunk that is turned about the vertical, then tilted about a horizontal axis [rad]."""
    turn, tilt, result = np.zeros(4), np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, [0.0, 0.0, 1.0], yaw)
    mujoco.mju_axisAngle2Quat(tilt, [0.6, 0.8, 0.0], angle)
    mujoco.mju_mulQuat(result, tilt, turn)
    return result
