"""Drawing recorded robots as a video: one of them, or several as tiles of a grid. Needs neither torch nor Warp."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from legged_torque.deploy.simulation import Simulation
from legged_torque.utils.errors import UserError
from legged_torque.utils.rendering import INSTALL_HINT

SIZE = (960, 540)
"""Width and height of a video of one robot [pixels]."""
GRID_SIZE = (1280, 720)
"""About the width and height of a video of several robots [pixels]."""
COMMAND_COLOR = (0.1, 0.8, 0.2, 0.9)
VELOCITY_COLOR = (0.1, 0.4, 1.0, 0.9)
_TEXT_COLORS = {"plain": (255, 255, 255), "command": (110, 240, 130), "velocity": (130, 190, 255)}
_BOX_COLOR = (20, 24, 30, 190)


@dataclass
class Moment:
    """What one robot does after a control step.

    Attributes:
        qpos: State of the MJCF's joints.
        command: Commanded v_x, v_y [m/s] and yaw rate [rad/s]. Shape: (3,).
        velocity: The trunk's actual v_x, v_y and yaw rate, in its own frame. Shape: (3,).
    """

    qpos: np.ndarray
    command: np.ndarray
    velocity: np.ndarray


class Recorder:
    """Keeps what the robot of :mod:`legged_torque.deploy.simulation` does, to draw it as a video."""

    def __init__(self, simulation: Simulation) -> None:
        """Record the robot of a simulation."""
        self._simulation = simulation
        self._steps: list[list[Moment]] = []

    def add_step(self) -> None:
        """Keep the state after a control step."""
        robot = self._simulation.robot
        velocity = np.append(robot.trunk_velocity()[:2], robot.trunk_angular_velocity()[2])
        self._steps.append([Moment(robot.data.qpos.copy(), self._simulation.command.copy(), velocity)])

    def save(self, file: Path) -> None:
        """Draw what was recorded, see :func:`write_video`."""
        robot, timing = self._simulation.robot, self._simulation.policy.description["timing"]
        write_video(file, robot.model, robot.trunk, self._steps, 1.0 / timing["control_frequency"])


def write_video(
    file: Path, model: mujoco.MjModel, trunk: int, steps: Sequence[Sequence[Moment]], control_step: float
) -> None:
    """Draw robots close up and write them as mp4, in real time, every second control step.

    A green arrow is the commanded velocity, a blue one the actual velocity; numbers tell both. Several robots are the
    tiles of a grid, row by row.

    Args:
        file: The mp4.
        model: One robot with its ground. The size of its off-screen buffer is changed.
        trunk: The robot's body that the camera follows.
        steps: For each control step, what each robot does; the number of robots is a square number.
        control_step: Time between two steps [s].

    Raises:
        UserError: If there is no renderer or no video encoder.
    """
    try:
        import imageio
        import imageio_ffmpeg  # noqa: F401
        import PIL  # noqa: F401
    except ImportError:
        raise UserError("videos need the extra: pip install -e .[video]") from None
    side = math.isqrt(len(steps[0]))
    width, height = SIZE if side == 1 else (length // side // 2 * 2 for length in GRID_SIZE)  # mp4 wants even numbers
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data = mujoco.MjData(model)
    try:
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # whatever the graphics driver raises
        raise UserError(f"the renderer does not start: {error} ({INSTALL_HINT})") from None
    file.parent.mkdir(parents=True, exist_ok=True)
    with renderer, imageio.get_writer(file, fps=round(0.5 / control_step), macro_block_size=1) as writer:
        for number, moments in list(enumerate(steps, start=1))[::2]:
            tiles = []
            for moment in moments:
                image = _draw(renderer, model, data, trunk, moment)
                rows = _table(number * control_step, moment) if side == 1 else _line(moment)
                tiles.append(add_overlay(image, rows))
            rows_of_tiles = [np.hstack(tiles[i : i + side]) for i in range(0, len(tiles), side)]
            writer.append_data(np.vstack(rows_of_tiles))


def _draw(
    renderer: mujoco.Renderer, model: mujoco.MjModel, data: mujoco.MjData, trunk: int, moment: Moment
) -> np.ndarray:
    """Return the image of a robot and the arrows of its velocities. Shape: (height, width, 3)."""
    data.qpos[:] = moment.qpos
    mujoco.mj_forward(model, data)
    position, rotation = data.xpos[trunk], data.xmat[trunk].reshape(3, 3)
    renderer.update_scene(data, camera=_follow(position))
    arrows = ((moment.command, COMMAND_COLOR, 0.24), (moment.velocity, VELOCITY_COLOR, 0.2))
    for vector, color, height in arrows:
        start = position + [0.0, 0.0, height]
        _add_arrow(renderer.scene, start, rotation @ [vector[0], vector[1], 0.0], color)
    return renderer.render()


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


# ---- numbers in the corner -------------------------------------------------------------------------------------------


def _table(time: float, moment: Moment) -> list[tuple[str, list[str]]]:
    """Return the overlay of a single robot: time, command, velocity."""
    return [
        ("plain", [f"{time:.2f} s", "v_x", "v_y", "yaw"]),
        ("command", ["command", *map(_number, moment.command)]),
        ("velocity", ["actual", *map(_number, moment.velocity)]),
        ("plain", ["", "m/s", "m/s", "rad/s"]),
    ]


def _line(moment: Moment) -> list[tuple[str, list[str]]]:
    """Return the short overlay of a tile: horizontal speed, commanded and actual."""
    told, actual = (np.linalg.norm(vector[:2]) for vector in (moment.command, moment.velocity))
    return [("command", ["command", f"{told:.2f} m/s"]), ("velocity", ["actual", f"{actual:.2f} m/s"])]


def _number(value: float) -> str:
    """Return a number with two digits and a sign, that of zero being +."""
    return f"{round(float(value), 2) + 0.0:+.2f}"


def add_overlay(image: np.ndarray, rows: list[tuple[str, list[str]]]) -> np.ndarray:
    """Write rows of text into the upper left corner, bright on a dark box that lets the image shine through.

    Args:
        image: Shape: (height, width, 3), 8 bits.
        rows: Color ("plain", "command" or "velocity") and words of each; the first word is set left, the others right.

    Returns:
        A new image.
    """
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture, "RGBA")
    size = max(11, picture.height // 22)
    font = ImageFont.load_default(size)
    first = 4.8 * size
    step = 3.4 * size if len(rows[0][1]) > 2 else 4.7 * size
    right = 0.5 * size + first + step * (len(rows[0][1]) - 1)
    box = [0.4 * size, 0.4 * size, right + 0.6 * size, (len(rows) * 1.3 + 0.9) * size]
    draw.rectangle(box, fill=_BOX_COLOR)
    for i, (color, words) in enumerate(rows):
        y = (1.65 + 1.3 * i) * size
        draw.text((0.9 * size, y), words[0], _TEXT_COLORS[color], font, anchor="ls")
        for j, word in enumerate(words[1:], start=1):
            draw.text((0.5 * size + first + step * j, y), word, _TEXT_COLORS[color], font, anchor="rs")
    return np.asarray(picture)
