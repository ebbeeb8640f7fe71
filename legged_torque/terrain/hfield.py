"""Rough ground in MuJoCo: for the engine ``mujoco_warp``, plain MuJoCo and viewers."""

from __future__ import annotations

import mujoco
import numpy as np

from legged_torque.terrain.height_grid import HeightGrid

_BASE = 1.0  # [m] how thick the ground is below its lowest place


def add_hfield(spec: mujoco.MjSpec, grid: HeightGrid, floor: str) -> None:
    """Make the geom ``floor`` of the world, usually a plane, a height field with the surface of a map.

    Friction and all else of the geom stay. MuJoCo keeps heights as shares of their range, in single precision, and has
    nothing outside of the map.
    """
    heights = grid.heights.T  # a row of MuJoCo's is along x
    lowest, highest = float(heights.min()), float(heights.max())
    x, y = (0.5 * side for side in grid.size)
    spec.add_hfield(
        name=floor,
        nrow=heights.shape[0],
        ncol=heights.shape[1],
        size=[x, y, max(highest - lowest, 1e-3), _BASE],  # level ground must have a height, too
        userdata=np.ascontiguousarray(heights).ravel(),
    )
    geom = next(geom for geom in spec.worldbody.geoms if geom.name == floor)
    geom.type, geom.hfieldname = mujoco.mjtGeom.mjGEOM_HFIELD, floor
    geom.pos = [grid.corner[0] + x, grid.corner[1] + y, lowest]
    geom.quat, geom.alt.type = [1.0, 0.0, 0.0, 0.0], mujoco.mjtOrientation.mjORIENTATION_QUAT
