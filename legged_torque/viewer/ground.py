"""Rough ground as videos and viewers draw it: one surface of few triangles, with a picture of its tiles on it.

Needs neither torch nor Warp.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from legged_torque.terrain.colors import NEUTRAL, color_of
from legged_torque.terrain.height_grid import HeightGrid
from legged_torque.terrain.layout import Layout
from legged_torque.utils.mjcf import loading, read_spec

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot

RESOLUTION, MOST_PIXELS = 32.0, 4096  # of the picture: pixels per metre, but no more than so many along a side
SHADES = (1.0, 0.94, 0.85)  # brightness of a tile, of lines on it that are 1 m apart, and of its edges
STRAIGHT, LARGEST = 1e-6, 20  # [m] how far lines of a rectangle may bend from sample to sample; cells of its sides
CLEARANCE = 0.3  # [m] how far above the ground a camera and its line of sight stay
SMOOTHING, JUMP = 0.1, 0.6  # share of a change by which heights of cameras follow in a frame, and what they jump to [m]


class Ground:
    """A map of tiles, to be drawn.

    Attributes:
        layout: Where its tiles lie.
        vertices: Corners of its triangles in the world [m]. Shape: (vertices, 3), float32.
        uv: Their places on the picture: from 0 to 1 along x and y of the world. Shape: (vertices, 2), float32.
        faces: The triangles, counterclockwise as seen from above. Shape: (triangles, 3), int32.
    """

    def __init__(self, layout: Layout, grid: HeightGrid) -> None:
        """Find the triangles of a grid with this layout."""
        self.layout = layout
        self._heights, self._scale = grid.heights, grid.horizontal_scale
        self._corner, size = np.array(grid.corner), np.array(grid.size)
        first_x, last_x, first_y, last_y = patches(self._heights).T
        rows, cols = np.stack([first_x, last_x, last_x, first_x]), np.stack([first_y, first_y, last_y, last_y])
        samples, corners = np.unique(rows * self._heights.shape[1] + cols, return_inverse=True)
        places = np.stack(np.unravel_index(samples, self._heights.shape), axis=1) * self._scale
        self.vertices = np.column_stack([places + self._corner, self._heights.flat[samples]]).astype(np.float32)
        self.uv = (places / size).astype(np.float32)
        triangles = corners.reshape(rows.shape)[[0, 1, 2, 0, 2, 3]]
        self.faces = np.ascontiguousarray(triangles.T, np.int32).reshape(-1, 3)

    def picture(self) -> np.ndarray:
        """Return the map from above, tiles in the colors of their kinds. Shape: (y, x of the world, 3), uint8."""
        layout = self.layout
        size = np.array(self._heights.shape) - 1
        per_metre = min(RESOLUTION, MOST_PIXELS / (size.max() * self._scale))
        pixels = np.rint(size * self._scale * per_metre).astype(int)
        places = [(np.arange(count) + 0.5) / per_metre - layout.border_size for count in pixels]
        tiles = [np.floor(place / layout.tile_size).astype(int) for place in places]
        shade_x, shade_y = (_shade(place, layout.tile_size, 1.0 / per_metre) for place in places)
        colors = np.array([*(color_of(kind) for kind in layout.kinds()), NEUTRAL])
        is_row = (tiles[0] >= 0) & (tiles[0] < layout.num_rows)
        is_col = (tiles[1] >= 0) & (tiles[1] < layout.num_cols)
        column = np.where(is_row & is_col[:, None], tiles[1][:, None], layout.num_cols)
        shades = (colors[:, None] * np.array(SHADES)[:, None]).astype(np.uint8)
        return shades[column, np.maximum(shade_x, shade_y[:, None])]

    def tile_text(self, row: int, column: int) -> str:
        """Return what a tile is, in words."""
        layout = self.layout
        return f"{layout.kinds()[column]}, level {row} (difficulty {layout.difficulty(row):.2f})"

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the height of the sample nearest to x and y of points [m]. Shapes: (..., 2 or more) to (...,)."""
        cells = np.rint((points[..., :2] - self._corner) / self._scale).astype(int)
        row, col = np.moveaxis(cells.clip(0, np.array(self._heights.shape) - 1), -1, 0)
        return self._heights[row, col]

    def lowest_view(self, target: np.ndarray, camera: np.ndarray) -> float:
        """Return how high a camera must be, above where it is, to see a target over the ground between them [m]."""
        share = np.linspace(0.25, 1.0, 31)
        ground = self.height(target + share[:, None] * (camera - target))
        return float((target[2] + (ground - target[2]) / share).max()) + CLEARANCE

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Draw this surface in place of a robot's plane, if it has one; it collides with nothing."""
        picture = self.picture()
        height, width, _ = picture.shape
        texture = spec.add_texture(name="ground", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
        texture.width, texture.height, texture.data = width, height, picture.tobytes()
        textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
        textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"
        spec.add_material(name="ground", textures=textures, specular=0.05, rgba=[0.72, 0.72, 0.72, 1.0])
        mesh = spec.add_mesh(name="ground", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        p0, p1, p2, _, _, p3 = self.faces.reshape(-1, 6).T
        corners = self.vertices[[p0, p1, p2, p3]].transpose(1, 0, 2)
        normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        mesh.uservert, mesh.usernormal = corners.ravel(), np.repeat(normals, 4, axis=0).ravel()  # so edges stay sharp
        mesh.usertexcoord = self.uv[[p0, p1, p2, p3]].transpose(1, 0, 2).ravel()
        starts = 4 * np.arange(len(p0), dtype=np.int32)[:, None]
        mesh.userface = (starts + np.array([0, 1, 2, 0, 2, 3], np.int32)).ravel()
        planes = [geom for geom in spec.worldbody.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
        floor = planes[0] if planes else spec.worldbody.add_geom()
        floor.type, floor.meshname, floor.material = mujoco.mjtGeom.mjGEOM_MESH, "ground", "ground"
        floor.pos, floor.quat, floor.contype, floor.conaffinity = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], 0, 0


def ground_of(task: LeggedRobot) -> Ground | None:
    """Return the ground of a task; None if it is a plane."""
    from legged_torque.terrain.rough import RoughGround

    return Ground(task.terrain.layout, task.terrain.map) if isinstance(task.terrain, RoughGround) else None


def drawn_model(robot: Path, ground: Ground | None, joints: Sequence[str] = ()) -> mujoco.MjModel:
    """Return the model of a robot's MJCF, visual geoms included, on its own plane or on rough ground, to draw it.

    ``joints`` are those of a task, in whose order its states are; without them, states are in that of the file.
    """
    spec = read_spec(robot, joints)
    if ground:
        ground.add_to(spec)
    with loading(robot):
        return spec.compile()


class Smooth:
    """A height that follows another one smoothly, except for jumps: those of robots that start anew."""

    def __init__(self) -> None:
        """Start at the first height."""
        self._height: float | None = None

    def follow(self, height: float) -> float:
        """Return the height at this frame [m]."""
        if self._height is None or abs(height - self._height) > JUMP:
            self._height = height
        self._height += SMOOTHING * (height - self._height)
        return self._height


def patches(heights: np.ndarray) -> np.ndarray:
    """Divide a map into rectangles that are level or ruled: much fewer than cells, and without holes between them.

    In each strip between two neighbouring lines along y, cells are joined as long as both lines are straight; then what
    has the same ends in neighbouring strips, as long as it is plane.

    Args:
        heights: Of the samples [m]. Shape: (rows, cols).

    Returns:
        First and last row, first and last column of each rectangle. Shape: (rectangles, 4), int64.
    """
    bends_y = np.abs(np.diff(heights, 2, axis=1)) > STRAIGHT
    is_end = np.ones((heights.shape[0] - 1, heights.shape[1]), bool)
    is_end[:, 1:-1] = bends_y[:-1] | bends_y[1:]
    is_end[:, ::LARGEST] = True
    starts = np.arange(0, len(is_end), LARGEST)
    is_end = np.logical_or.reduceat(is_end, starts).repeat(np.diff(starts, append=len(is_end)), axis=0)
    strip, col = np.nonzero(is_end)
    is_run = strip[:-1] == strip[1:]
    strip, first, last = strip[:-1][is_run], col[:-1][is_run], col[1:][is_run]
    order = np.lexsort((strip, last, first))
    strip, first, last = strip[order], first[order], last[order]
    rise_first, rise_last = (heights[strip + 1, col] - heights[strip, col] for col in (first, last))
    is_plane = np.abs(rise_first - rise_last) < STRAIGHT
    goes_on = (np.diff(first) == 0) & (np.diff(last) == 0) & (np.diff(strip) == 1) & is_plane[1:] & is_plane[:-1]
    goes_on &= (np.abs(np.diff(rise_first)) < STRAIGHT) & (strip[1:] % LARGEST != 0)
    begins, ends = np.append(True, ~goes_on), np.append(~goes_on, True)
    return np.stack([strip[begins], strip[ends] + 1, first[begins], last[begins]], axis=1)


def _shade(places: np.ndarray, tile_size: float, pixel: float) -> np.ndarray:
    """Return which of :data:`SHADES` places along an axis have, by their distance from the first tile [m]."""
    is_line, is_edge = (np.abs((places + 0.5 * step) % step - 0.5 * step) < 0.6 * pixel for step in (1.0, tile_size))
    return np.where(is_edge, 2, is_line.astype(int))
