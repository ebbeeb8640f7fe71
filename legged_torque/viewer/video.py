"""Videos of one robot, or of several as tiles of a grid. Needs neither torch nor Warp."""

from __future__ import annotations

import io
import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from legged_torque import resource_path
from legged_torque.deploy.simulation import Simulation
from legged_torque.terrain.height_grid import HeightGrid
from legged_torque.terrain.layout import Layout
from legged_torque.utils.display import Counter
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import write_whole
from legged_torque.utils.rendering import INSTALL_HINT
from legged_torque.viewer.arrows import add_velocities
from legged_torque.viewer.framing import TRUNK, size_of
from legged_torque.viewer.ground import Ground, Smooth, drawn_model, ground_of

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot

SIZE = (960, 540)  # width and height of a video of one robot [pixels]
GRID_SIZE = (1280, 720)  # about the width and height of a video of several robots [pixels]
DISTANCE, TARGET = 1.6, 0.25  # of the camera from what it looks at on level ground, which is so high [m]; of an A1
_TEXT_COLORS = {"plain": (255, 255, 255), "command": (110, 240, 130), "velocity": (130, 190, 255)}
_BOX_COLOR = (20, 24, 30, 190)


@dataclass
class Moment:
    """What one robot does after a control step; command and velocity are v_x, v_y [m/s] and yaw rate [rad/s]."""

    qpos: np.ndarray  # of the MJCF's joints
    command: np.ndarray  # (3,)
    velocity: np.ndarray  # of the trunk, in its own frame; (3,)


class VideoRecorder:
    """Keeps what robots do, to draw them as a video."""

    def __init__(self, model: mujoco.MjModel, trunk: int, control_step: float, ground: Ground | None = None) -> None:
        """Start without any steps; arguments as of :func:`write_video`."""
        self._model, self._trunk, self._control_step, self._ground = model, trunk, control_step, ground
        self._steps: list[list[Moment]] = []

    def save(self, file: Path, no_renderer: str | None) -> bool:
        """Draw and write an mp4 and print where it is, or why there is none; ``no_renderer`` is one such reason.

        What is returned is whether there is one.
        """
        try:
            if no_renderer:
                raise UserError(no_renderer)
            write_video(file, self._model, self._trunk, self._steps, self._control_step, self._ground)
            print(f"video: {file}")
            return True
        except UserError as error:
            print(f"no video: {error}")
            return False


class SimulationRecorder(VideoRecorder):
    """Records the robot of :mod:`legged_torque.deploy.simulation`."""

    def __init__(self, simulation: Simulation) -> None:
        """Prepare to record a simulation."""
        robot, description = simulation.robot, simulation.policy.description
        ground, model = None, robot.model
        if "terrain" in description and model.nhfield:
            layout = Layout(**description["terrain"])
            ground = Ground(layout, HeightGrid(layout.heights(), layout.horizontal_scale, layout.corner))
            model = drawn_model(robot.file, ground)
        super().__init__(model, robot.trunk, 1.0 / description["timing"]["control_frequency"], ground)
        self._simulation = simulation

    def add_step(self) -> None:
        """Keep the state after a control step."""
        simulation, robot = self._simulation, self._simulation.robot
        self._steps.append([Moment(robot.data.qpos.copy(), simulation.command.copy(), robot.planar_velocity())])


class TaskRecorder(VideoRecorder):
    """Records worlds of a task."""

    def __init__(self, task: LeggedRobot, num_worlds: int = 1) -> None:
        """Prepare to record the first worlds of a task; a single one is that with the fastest command at the start."""
        ground = ground_of(task)
        model = drawn_model(resource_path(task.cfg.asset.file), ground, task.dof_names)
        super().__init__(model, TRUNK, task.dt, ground)
        self._task = task
        self._worlds = list(range(num_worlds)) if num_worlds > 1 else []

    def add_step(self) -> None:
        """Keep the state after a control step."""
        task = self._task
        self._worlds = self._worlds or [int(task.commands[:, :2].norm(dim=1).argmax())]
        tensors = (task.sim.qpos, task.commands, task.state.planar_velocity())
        parts = [tensor[self._worlds].double().cpu().numpy() for tensor in tensors]
        self._steps.append([Moment(*moment) for moment in zip(*parts, strict=True)])


def write_video(
    file: Path,
    model: mujoco.MjModel,
    trunk: int,
    steps: Sequence[Sequence[Moment]],
    control_step: float,
    ground: Ground | None = None,
) -> None:
    """Write an mp4 of robots seen close up, in real time, with a frame for every second control step.

    A green arrow is the commanded velocity, a blue one the actual velocity; numbers show both. Several robots are the
    tiles of a grid, row by row.

    Args:
        file: The mp4.
        model: One robot with its ground. The size of its off-screen buffer is changed.
        trunk: Body that the camera follows.
        steps: What each robot does in each control step; the number of robots is a square number.
        control_step: Time between two steps [s].
        ground: That of the model, above which cameras stay; None for a plane.

    Raises:
        UserError: If there is no renderer or no video encoder.
    """
    try:
        import imageio
        import imageio_ffmpeg  # noqa: F401
        import PIL  # noqa: F401
    except ImportError:
        raise UserError("videos need the extra: pip install 'legged_torque[video]'") from None
    side = math.isqrt(len(steps[0]))
    width, height = SIZE if side == 1 else (length // side // 2 * 2 for length in GRID_SIZE)  # mp4 wants even numbers
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data = mujoco.MjData(model)
    try:
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # whatever the graphics driver raises
        raise UserError(f"the renderer does not start: {error} ({INSTALL_HINT})") from None
    size = size_of(model)
    cameras = [Camera(ground, size) for _ in steps[0]]
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / file.name
        writer = imageio.get_writer(part, fps=round(0.5 / control_step), macro_block_size=1)
        shown = list(enumerate(steps, start=1))[::2]
        with renderer, writer, Counter("rendering, frame", len(shown)) as counter:
            for number, moments in shown:
                tiles = []
                for moment, camera in zip(moments, cameras, strict=True):
                    image = _draw(renderer, data, trunk, moment, camera, size)
                    rows = _table(number * control_step, moment) if side == 1 else _line(moment)
                    tiles.append(add_overlay(image, rows))
                rows_of_tiles = [np.hstack(tiles[i : i + side]) for i in range(0, len(tiles), side)]
                writer.append_data(np.vstack(rows_of_tiles))
                counter.add()
        write_whole(file, part.read_bytes())


def show_in_tensorboard(video: Path, iterations: int) -> None:
    """Add a video to those that tensorboard shows beside the curves of a run, as events in the video's folder."""
    import imageio
    from PIL import Image
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.summary.writer.event_file_writer import EventFileWriter

    reader: Any = imageio.get_reader(video)
    with reader:
        duration = 2000.0 / reader.get_meta_data()["fps"]  # of every second frame [ms]
        frames = [Image.fromarray(frame[::2, ::2]) for number, frame in enumerate(reader) if number % 2 == 0]
    gif = io.BytesIO()
    frames[0].save(gif, "GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0)
    size = {"width": frames[0].width, "height": frames[0].height, "colorspace": 3}
    value = Summary.Value(tag="video", image=Summary.Image(**size, encoded_image_string=gif.getvalue()))
    writer = EventFileWriter(str(video.parent))
    writer.add_event(Event(wall_time=time.time(), step=iterations, summary=Summary(value=[value])))
    writer.close()


class Camera:
    """Looks at a robot from a fixed direction, from above the ground."""

    def __init__(self, ground: Ground | None, size: float) -> None:
        """Prepare for a video of a robot of a :func:`size_of`; None is a plane."""
        self._ground, self._size, self._target, self._height = ground, size, Smooth(), Smooth()

    def look_at(self, position: np.ndarray) -> mujoco.MjvCamera:
        """Return the camera of a frame, by the position of the robot's trunk [m]."""
        camera, elevation = mujoco.MjvCamera(), np.radians(18.0)
        camera.lookat[:] = (position[0], position[1], self._size * TARGET)
        camera.azimuth = 130.0
        distance = self._size * DISTANCE
        ahead, height = distance * np.cos(elevation), distance * np.sin(elevation)
        if self._ground:
            camera.lookat[2] += self._target.follow(float(self._ground.height(position)))
            azimuth = np.radians(camera.azimuth)
            place = camera.lookat - ahead * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            lowest = self._ground.lowest_view(camera.lookat, place)
            height = self._height.follow(max(camera.lookat[2] + height, lowest)) - camera.lookat[2]
        camera.distance, camera.elevation = np.hypot(ahead, height), -np.degrees(np.arctan2(height, ahead))
        return camera


def _draw(
    renderer: mujoco.Renderer, data: mujoco.MjData, trunk: int, moment: Moment, camera: Camera, size: float
) -> np.ndarray:
    """Return the image of a robot of a :func:`size_of` and the arrows of its velocities. Shape: (height, width, 3)."""
    data.qpos[:] = moment.qpos
    mujoco.mj_forward(renderer.model, data)
    renderer.update_scene(data, camera.look_at(data.xpos[trunk]))
    add_velocities(renderer.scene, data, trunk, moment.command, moment.velocity, size)
    return renderer.render()


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
    """Return a number with a sign and two decimals; zero is +0.00."""
    return f"{round(float(value), 2) + 0.0:+.2f}"


def add_overlay(image: np.ndarray, rows: list[tuple[str, list[str]]]) -> np.ndarray:
    """Return an image with rows of text in the upper left corner, bright on a translucent dark box.

    Args:
        image: Shape: (height, width, 3), 8 bits.
        rows: Color ("plain", "command" or "velocity") and words; the first is left-aligned, the others right-aligned.
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
