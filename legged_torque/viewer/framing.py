"""How far cameras stand from a robot, by its size. Needs neither torch nor Warp."""

from __future__ import annotations

import mujoco
import numpy as np

TRUNK = 1  # the trunk's body in the MJCF of a task
A1_HEIGHT = 0.485  # from the feet of the A1 to its top where all angles are 0 [m]; pictures are laid out for it


def size_of(model: mujoco.MjModel) -> float:
    """Return how tall a robot is where all its angles are 0, in heights of the A1, to a tenth; that of the A1 is 1."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    moving = model.body_weldid[model.geom_bodyid] > 0
    upward = data.geom_xmat.reshape(-1, 3, 3)[moving, 2]  # the vertical in the frames of the geoms
    middle, half = model.geom_aabb[moving, :3], model.geom_aabb[moving, 3:]
    heights = data.geom_xpos[moving, 2] + (upward * middle).sum(axis=1)
    reach = (np.abs(upward) * half).sum(axis=1)
    return max(round(float((heights + reach).max() - (heights - reach).min()) / A1_HEIGHT, 1), 0.1)
