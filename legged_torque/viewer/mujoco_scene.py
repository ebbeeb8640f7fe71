"""Robots, cameras and arrows in scenes of MuJoCo, scaled to the size of the robot. Needs neither torch nor Warp."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from legged_torque import resource_path
from legged_torque.viewer.ground import Ground, drawn_model

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot

TRUNK = 1  # body of the trunk in the MJCF of a task
A1_HEIGHT = 0.485  # from the feet of the A1 to its top at zero joint angles [m]
AZIMUTH, ELEVATION = 130.0, 18.0  # direction of a video's camera and how far it looks down [degrees]
DISTANCE, TARGET = 1.6, 0.25  # of a video's camera to its target, height of the target; for the A1 on level ground [m]
SMOOTHING = 0.1  # share of a change of height that is followed per frame
JUMP = 0.6  # change of height that is followed at once [m]
ARROW_LENGTH = 0.5  # for 1 m/s [m]
COMMAND_HEIGHT, VELOCITY_HEIGHT = 0.24, 0.18  # of the arrows above the trunk's origin, for the A1 [m]
MIN_SPEED = 0.05  # of a velocity with an arrow [m/s]
COMMAND_COLOR, VELOCITY_COLOR = (0.1, 0.8, 0.2, 0.9), (0.1, 0.4, 1.0, 0.9)
ARROW_RADIUS = 0.012  # of an arrow's shaft [m]


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
        terrain: Any = task.terrain  # rough ground if it has a map
        ground = Ground(terrain.layout, terrain.map) if terrain.map else None
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
        for vector, color, height in (
            (command, COMMAND_COLOR, COMMAND_HEIGHT),
            (velocity, VELOCITY_COLOR, VELOCITY_HEIGHT),
        ):
            if np.hypot(*vector[:2]) < MIN_SPEED or scene.ngeom >= scene.maxgeom:
                continue
            start = self.data.xpos[self.trunk] + [0.0, 0.0, self.size * height]
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(color, np.float32))
            mujoco.mjv_connector(geom, kind, ARROW_RADIUS, start, start + ARROW_LENGTH * rotation[:, :2] @ vector[:2])
            scene.ngeom += 1
