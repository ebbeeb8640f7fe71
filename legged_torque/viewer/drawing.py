"""A robot on its ground as MuJoCo draws it: rough ground as a surface of few triangles, cameras, and arrows.

All is scaled to the size of the robot. Needs neither torch nor Warp.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from legged_torque import resource_path
from legged_torque.terrain.layout import Layout
from legged_torque.utils.mjcf import loading, read_spec

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot

TRUNK = 1  # body of the trunk in the MJCF of a task
A1_HEIGHT = 0.485  # from the feet of the A1 to its top at zero joint angles [m]
AZIMUTH, ELEVATION = 130.0, 18.0  # direction of a video's camera and how far it looks down [degrees]
DISTANCE, TARGET = 1.6, 0.25  # of a video's camera to its target, height of the target; for the A1 on level ground [m]
SMOOTHING = 0.1  # share of a change of height that is followed per frame
JUMP = 0.6  # change of height that is followed at once [m]
ARROW_LENGTH = 0.5  # for 1 m/s [m]
HEIGHTS = (0.24, 0.18)  # of the arrows of command and velocity above the trunk's origin, for the A1 [m]
MIN_SPEED = 0.05  # of a velocity with an arrow [m/s]
ARROW_COLORS = ((0.1, 0.8, 0.2, 0.9), (0.1, 0.4, 1.0, 0.9))  # of the same
ARROW_RADIUS = 0.012  # of an arrow's shaft [m]

RESOLUTION, MAX_PIXELS = 32.0, 4096  # of the picture: pixels per metre, and limit along a side
NEUTRAL = (206, 208, 210)
"""Of level ground, and of what lies around the tiles. Each color is red, green and blue, up to 255."""
COLORS = {
    "flat": NEUTRAL,
    "smooth_slope_up": (176, 203, 164),
    "smooth_slope_down": (143, 186, 158),
    "rough_slope": (199, 193, 143),
    "stairs_up": (151, 186, 213),
    "stairs_down": (172, 172, 217),
    "discrete_obstacles": (222, 177, 148),
    "waves": (140, 200, 198),
    "stepping_stones": (207, 166, 198),
    "gaps": (224, 160, 160),
    "pits": (228, 207, 140),
}
"""Of kinds of tiles: calm ones, on which dark robots are seen well."""
OWN = (204, 190, 214)  # of kinds that users have added
SHADES = (1.0, 0.94, 0.85)  # brightness of a tile, of lines on it that are 1 m apart, and of its edges
LINE_WIDTH = 1.2  # of lines and edges [pixels]
STRAIGHT = 1e-6  # largest bend between neighbouring samples of a straight line [m]
MAX_CELLS = 20  # along a side of a rectangle
CLEARANCE = 0.3  # of a camera and its line of sight above the ground [m]
REFLECTANCE = [0.72, 0.72, 0.72, 1.0]  # of the picture in MuJoCo's light


class Drawing:
    """A robot on its ground, as MuJoCo draws it.

    Attributes:
        model: For drawing, with visual geoms.
        data: The robot's present state.
        ground: None is a plane.
        trunk: Body that cameras follow.
        size: See :func:`size_of`.
    """

    def __init__(self, model: mujoco.MjModel, ground: Ground | None = None, trunk: int = TRUNK) -> None:
        """Start with all joints at zero."""
        self.model, self.ground, self.trunk = model, ground, trunk
        self.data, self.size = mujoco.MjData(model), size_of(model)

    @classmethod
    def of_task(cls, task: LeggedRobot) -> Drawing:
        """Return the robot of a task on its ground, with the joints in the task's order."""
        layout = getattr(task.terrain, "layout", None)
        ground = Ground(layout) if isinstance(layout, Layout) else None  # a user's own is drawn as a plane
        return cls(drawn_model(resource_path(task.cfg.asset.file), ground, task.dof_names), ground)

    def move(self, qpos: np.ndarray) -> None:
        """Move the robot. Shape: (nq,)."""
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)

    def add_velocities(self, scene: mujoco.MjvScene, command: np.ndarray, velocity: np.ndarray) -> None:
        """Draw commanded and actual velocity above the robot.

        They begin with v_x and v_y in the trunk's frame [m/s]; what follows is not drawn.
        """
        kind, rotation = mujoco.mjtGeom.mjGEOM_ARROW, self.data.xmat[self.trunk].reshape(3, 3)
        for vector, color, height in zip((command, velocity), ARROW_COLORS, HEIGHTS, strict=True):
            if np.hypot(*vector[:2]) < MIN_SPEED or scene.ngeom >= scene.maxgeom:
                continue
            start = self.data.xpos[self.trunk] + [0.0, 0.0, self.size * height]
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(color, np.float32))
            mujoco.mjv_connector(geom, kind, ARROW_RADIUS, start, start + ARROW_LENGTH * rotation[:, :2] @ vector[:2])
            scene.ngeom += 1


class Camera:
    """A video's camera: follows a robot from a fixed direction and stays above the ground."""

    def __init__(self, ground: Ground | None, size: float) -> None:
        """Prepare for a robot of a :func:`size_of`; a ground of None is a plane."""
        self._ground, self._size = ground, size
        self._below: float | None = None  # smoothed height of the ground [m]
        self._height: float | None = None  # smoothed height of the camera [m]

    def look_at(self, position: np.ndarray) -> mujoco.MjvCamera:
        """Return the camera of the next frame for a trunk at a position in the world [m]. Shape: (3,)."""
        camera, azimuth, elevation = mujoco.MjvCamera(), np.radians(AZIMUTH), np.radians(ELEVATION)
        camera.lookat[:] = (position[0], position[1], self._size * TARGET)
        ahead, height = self._size * DISTANCE * np.array([np.cos(elevation), np.sin(elevation)])
        if self._ground:
            self._below = smoothed(self._below, float(self._ground.height(position)))
            camera.lookat[2] += self._below
            place = camera.lookat - ahead * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            lowest = self._ground.lowest_view(camera.lookat, place)
            self._height = smoothed(self._height, max(camera.lookat[2] + height, lowest))
            height = self._height - camera.lookat[2]
        camera.azimuth, camera.elevation = AZIMUTH, -np.degrees(np.arctan2(height, ahead))
        camera.distance = np.hypot(ahead, height)
        return camera


def size_of(model: mujoco.MjModel) -> float:
    """Return the height of a robot at zero joint angles in heights of the A1, rounded to a tenth."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    moving = model.body_weldid[model.geom_bodyid] > 0
    upward = data.geom_xmat.reshape(-1, 3, 3)[moving, 2]  # the vertical in the frames of the geoms
    middle, half = model.geom_aabb[moving, :3], model.geom_aabb[moving, 3:]
    heights = data.geom_xpos[moving, 2] + (upward * middle).sum(axis=1)
    reach = (np.abs(upward) * half).sum(axis=1)
    return max(round(float((heights + reach).max() - (heights - reach).min()) / A1_HEIGHT, 1), 0.1)


def smoothed(before: float | None, height: float) -> float:
    """Return the next value of a height [m] that follows another one smoothly, but jumps with new episodes."""
    if before is None or abs(height - before) > JUMP:
        return height
    return before + SMOOTHING * (height - before)


class Ground:
    """The surface of a height map.

    Attributes:
        layout: The tiles of the map.
        vertices: Corners of the triangles in the world [m]. Shape: (vertices, 3), float32.
        uv: Texture coordinates of the corners, 0 to 1 along x and y of the world. Shape: (vertices, 2), float32.
        faces: The triangles, counterclockwise as seen from above. Shape: (triangles, 3), int32.
    """

    def __init__(self, layout: Layout) -> None:
        """Divide the map of a layout into triangles."""
        self.layout = layout
        self._heights, self._scale, self._corner = layout.heights(), layout.horizontal_scale, np.array(layout.corner)
        rectangles = patches(self._heights)
        rows, cols = rectangles[:, [0, 1, 1, 0]], rectangles[:, [2, 2, 3, 3]]
        samples, corners = np.unique(rows * self._heights.shape[1] + cols, return_inverse=True)
        places = np.stack(np.unravel_index(samples, self._heights.shape), axis=1) * self._scale
        self.vertices = np.column_stack([places + self._corner, self._heights.flat[samples]]).astype(np.float32)
        self.uv = (places / places.max(axis=0)).astype(np.float32)
        self._rectangles = corners.reshape(rows.shape)
        self.faces = self._rectangles[:, [0, 1, 2, 0, 2, 3]].astype(np.int32).reshape(-1, 3)

    def picture(self) -> np.ndarray:
        """Return a picture of the map from above, with a color per kind. Shape: (y, x of the world, 3), uint8."""
        layout = self.layout
        size = np.array(self._heights.shape) - 1
        per_metre = min(RESOLUTION, MAX_PIXELS / (size.max() * self._scale))
        tiles, shades = [], []
        for cells in size:
            pixels = np.arange(np.rint(cells * self._scale * per_metre))
            place = (pixels + 0.5) / per_metre - layout.border_size  # from the first tile [m]
            steps, half = (1.0, layout.tile_size), 0.5 * LINE_WIDTH / per_metre
            is_line, is_edge = (np.abs((place + 0.5 * step) % step - 0.5 * step) < half for step in steps)
            tiles.append(np.floor(place / layout.tile_size).astype(int))
            shades.append(np.where(is_edge, 2, is_line.astype(int)))
        colors = np.array([*(COLORS.get(kind, OWN) for kind in layout.kinds()), NEUTRAL])
        is_row = (tiles[0] >= 0) & (tiles[0] < layout.num_rows)
        is_col = (tiles[1] >= 0) & (tiles[1] < layout.num_cols)
        column = np.where(is_row & is_col[:, None], tiles[1][:, None], layout.num_cols)
        shaded = (colors[:, None] * np.array(SHADES)[:, None]).astype(np.uint8)
        return shaded[column, np.maximum(shades[0], shades[1][:, None])]

    def tile_text(self, row: int, column: int) -> str:
        """Return the kind, level and difficulty of a tile as text."""
        layout = self.layout
        return f"{layout.kinds()[column]}, level {row} (difficulty {layout.difficulty(row):.2f})"

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the heights of the samples nearest to points [m]. Shapes: (..., 2 or more) to (...,)."""
        cells = np.rint((points[..., :2] - self._corner) / self._scale).astype(int)
        row, col = np.moveaxis(cells.clip(0, np.array(self._heights.shape) - 1), -1, 0)
        return self._heights[row, col]

    def lowest_view(self, target: np.ndarray, camera: np.ndarray) -> float:
        """Return the lowest height at which a camera sees a target over the ground between them [m].

        Shapes: (3,) each, in the world.
        """
        share = np.linspace(0.25, 1.0, 31)
        ground = self.height(target + share[:, None] * (camera - target))
        return float((target[2] + (ground - target[2]) / share).max()) + CLEARANCE

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add this surface to a robot's model without collisions, in place of its plane if it has one."""
        picture = self.picture()
        height, width, _ = picture.shape
        texture = spec.add_texture(name="ground", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
        texture.width, texture.height, texture.data = width, height, picture.tobytes()
        textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
        textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"
        spec.add_material(name="ground", textures=textures, specular=0.05, rgba=REFLECTANCE)
        mesh = spec.add_mesh(name="ground", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        corners = self.vertices[self._rectangles]
        normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        mesh.uservert, mesh.usernormal = corners.ravel(), np.repeat(normals, 4, axis=0).ravel()  # so edges stay sharp
        mesh.usertexcoord = self.uv[self._rectangles].ravel()
        starts = 4 * np.arange(len(corners), dtype=np.int32)[:, None]
        mesh.userface = (starts + np.array([0, 1, 2, 0, 2, 3], np.int32)).ravel()
        planes = [geom for geom in spec.worldbody.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
        floor = planes[0] if planes else spec.worldbody.add_geom()
        floor.type, floor.meshname, floor.material = mujoco.mjtGeom.mjGEOM_MESH, "ground", "ground"
        floor.pos, floor.quat, floor.contype, floor.conaffinity = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], 0, 0


def drawn_model(robot: Path, ground: Ground | None, joints: Sequence[str] = ()) -> mujoco.MjModel:
    """Return a robot's model for drawing, with visual geoms, on its own plane or on rough ground.

    Positions of joints are in the order of ``joints``, a task's names of them, or without names in that of the file.
    """
    spec = read_spec(robot, joints)
    if ground:
        ground.add_to(spec)
    with loading(robot):
        return spec.compile()


def patches(heights: np.ndarray) -> np.ndarray:
    """Divide a map into rectangles with straight sides: far fewer than cells, and without holes between them.

    In each strip between two neighbouring lines along y, cells are joined while both lines are straight. Then runs with
    the same ends in neighbouring strips are joined while they lie in one plane.

    Args:
        heights: Of the samples [m]. Shape: (rows, cols).

    Returns:
        First and last row, first and last column of each rectangle. Shape: (rectangles, 4), int64.
    """
    bends_y = np.abs(np.diff(heights, 2, axis=1)) > STRAIGHT
    is_end = np.ones((heights.shape[0] - 1, heights.shape[1]), bool)
    is_end[:, 1:-1] = bends_y[:-1] | bends_y[1:]
    is_end[:, ::MAX_CELLS] = True
    starts = np.arange(0, len(is_end), MAX_CELLS)
    is_end = np.logical_or.reduceat(is_end, starts).repeat(np.diff(starts, append=len(is_end)), axis=0)
    strip, col = np.nonzero(is_end)
    is_run = strip[:-1] == strip[1:]
    strip, first, last = strip[:-1][is_run], col[:-1][is_run], col[1:][is_run]
    order = np.lexsort((strip, last, first))
    strip, first, last = strip[order], first[order], last[order]
    rise_first, rise_last = (heights[strip + 1, col] - heights[strip, col] for col in (first, last))
    is_plane = np.abs(rise_first - rise_last) < STRAIGHT
    goes_on = (np.diff(first) == 0) & (np.diff(last) == 0) & (np.diff(strip) == 1) & is_plane[1:] & is_plane[:-1]
    goes_on &= (np.abs(np.diff(rise_first)) < STRAIGHT) & (strip[1:] % MAX_CELLS != 0)
    begins, ends = np.append(True, ~goes_on), np.append(~goes_on, True)
    return np.stack([strip[begins], strip[ends] + 1, first[begins], last[begins]], axis=1)
