"""The ground of a policy's training in plain MuJoCo, and heights of any ground."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from legged_torque.terrain.height_grid import HeightGrid
from legged_torque.terrain.hfield import add_hfield
from legged_torque.terrain.layout import Layout
from legged_torque.terrain.selection import COLUMNS, named_kinds, rising_levels, select_tiles
from legged_torque.utils.config import update_from_dict

_ABOVE = 100.0  # height from which rays look down on the ground [m]


def select_ground(description: dict[str, Any], settings: Any, kinds: Sequence[str], levels: Sequence[float]) -> None:
    """Change the ground of ``policy.yaml`` to tiles of some kinds at some difficulties, by default those of training.

    A policy of a plane takes everything else, such as the size of tiles, from ``settings``, a section ``terrain`` that
    is changed.
    """
    update_from_dict(settings, {**description.get("terrain", {}), "terrain_proportions": {}})
    select_tiles(settings, named_kinds(kinds), rising_levels(levels), COLUMNS)
    description["terrain"] = dataclasses.asdict(Layout.of(settings))


def place_ground(spec: mujoco.MjSpec, description: dict[str, Any], notes: list[str]) -> np.ndarray:
    """Put the ground of ``policy.yaml`` into an MJCF in place of its plane, and return where robots may start.

    An MJCF with other ground than one plane keeps its own. Adds to ``notes`` what is added or kept. Returns the middles
    of all tiles, or the origin. Shape: (tiles, 3) [m]. A UserError if there can be no such ground.
    """
    grounds = [geom for geom in spec.worldbody.geoms if geom.contype or geom.conaffinity]
    if not grounds:
        grounds = [spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05])]
        what = "the ground of policy.yaml" if "terrain" in description else "a plane at height 0"
        notes.append(f"the MJCF has no floor: {what} is added")
    if "terrain" not in description:
        return np.zeros((1, 3))
    if [geom.type for geom in grounds] != [mujoco.mjtGeom.mjGEOM_PLANE]:
        notes.append("the MJCF has ground of its own, on which the robot starts at the origin, not that of policy.yaml")
        return np.zeros((1, 3))
    layout = Layout(**description["terrain"])
    layout.check()
    heights, (floor,) = layout.heights(), grounds
    floor.name = floor.name or "floor"
    add_hfield(spec, HeightGrid(heights, layout.horizontal_scale, layout.corner), floor.name)
    return layout.origins(heights).reshape(-1, 3)


def ground_heights(model: mujoco.MjModel, data: mujoco.MjData, geoms: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the height of the highest of some geoms at x and y of places; -inf where there is none [m].

    Shapes: (geoms,) numbers, (places, 2) [m], (places,). ``data`` must have the geoms' positions.
    """
    heights = np.full(len(places), -np.inf)
    for i, (x, y) in enumerate(places):
        for geom in geoms:
            depth = _depth(model, data, int(geom), np.array([x, y, _ABOVE]))
            if depth >= 0.0:
                heights[i] = max(heights[i], _ABOVE - depth)
    return heights


def _depth(model: mujoco.MjModel, data: mujoco.MjData, geom: int, point: np.ndarray) -> float:
    """Return the distance from a point straight down to a geom [m]; -1 if there is none."""
    kind, down = model.geom_type[geom], np.array([0.0, 0.0, -1.0])
    if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
        return mujoco.mj_rayHfield(model, data, geom, point, down)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return mujoco.mj_rayMesh(model, data, geom, point, down)
    is_plane = kind == mujoco.mjtGeom.mjGEOM_PLANE  # which is infinite; its size is only drawn
    size = np.zeros(3) if is_plane else model.geom_size[geom]
    return mujoco.mju_rayGeom(data.geom_xpos[geom], data.geom_xmat[geom], size, point, down, kind)
