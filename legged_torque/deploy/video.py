"""Recording a robot of :mod:`legged_torque.deploy.simulation` and drawing it afterwards."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from legged_torque.deploy.simulation import Simulation
from legged_torque.utils.errors import UserError
from legged_torque.utils.rendering import INSTALL_HINT

WIDTH, HEIGHT = 960, 540
COMMAND_COLOR = (0.1, 0.8, 0.2, 0.9)
VELOCITY_COLOR = (0.1, 0.4, 1.0, 0.9)


class Recorder:
    """Keeps what a robot does, to draw it as a video."""

    def __init__(self, simulation: Simulation) -> None:
        """Record the robot of a simulation."""
        self._simulation = simulation
        self._frames: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add_step(self) -> None:
        """Keep the state after a control step."""
        robot = self._simulation.robot
        self._frames.append((robot.data.qpos.copy(), self._simulation.command.copy(), robot.trunk_velocity()))

    def save(self, file: Path) -> None:
        """Draw what was recorded and write it as mp4, in real time, every second control step.

        A green arrow is the commanded velocity, a blue one the actual velocity.

        Raises:
            UserError: If there is no renderer or no video encoder.
        """
        try:
            import imageio
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            raise UserError("videos need the extra: pip install -e .[video]") from None
        robot = self._simulation.robot
        model, data = robot.model, mujoco.MjData(robot.model)
        model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
        try:
            renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        except Exception as error:  # whatever the graphics driver raises
            raise UserError(f"the renderer does not start: {error} ({INSTALL_HINT})") from None
        fps = round(0.5 * self._simulation.policy.description["timing"]["control_frequency"])
        file.parent.mkdir(parents=True, exist_ok=True)
        with renderer, imageio.get_writer(file, fps=fps, macro_block_size=1) as writer:
            for qpos, command, velocity in self._frames[::2]:
                data.qpos[:] = qpos
                mujoco.mj_forward(model, data)
                position, rotation = data.xpos[robot.trunk], data.xmat[robot.trunk].reshape(3, 3)
                renderer.update_scene(data, camera=_follow(position))
                for vector, color, height in ((command, COMMAND_COLOR, 0.24), (velocity, VELOCITY_COLOR, 0.2)):
                    start = position + [0.0, 0.0, height]
                    _add_arrow(renderer.scene, start, rotation @ [vector[0], vector[1], 0.0], color)
                writer.append_data(renderer.render())


def _follow(position: np.ndarray) -> mujoco.MjvCamera:
    """Return a camera that looks at the robot from the side and keeps its direction."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (position[0], position[1], 0.25)
    camera.distance, camera.azimuth, camera.elevation = 1.6, 130.0, -18.0
    return camera


def _add_arrow(scene: mujoco.MjvScene, start: np.ndarray, vector: np.ndarray, color: tuple[float, ...]) -> None:
    """Draw a velocity [m/s] as an arrow, 0.5 m long for 1 m/s."""
    if np.linalg.norm(vector) < 1e-3 or scene.ngeom >= scene.maxgeom:
        return
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_ARROW, np.zeros(3), np.zeros(3), np.zeros(9), np.float32(color))
    mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, 0.012, start, start + 0.5 * vector)
    scene.ngeom += 1
