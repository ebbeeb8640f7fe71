"""Videos of one robot, or of several as tiles of a grid. Needs neither torch nor Warp."""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from legged_torque.deploy.simulation import Simulation
from legged_torque.terrain.layout import Layout
from legged_torque.utils.devices import INSTALL_HINT
from legged_torque.utils.display import Counter
from legged_torque.utils.errors import UserError, require
from legged_torque.utils.files import write_whole
from legged_torque.viewer.drawing import Camera, Drawing, Ground, drawn_model

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot

SIZE = (960, 540)  # width and height of a video of one robot [pixels]
GRID_SIZE = (1280, 720)  # the same of several robots, which are rounded down to equal tiles [pixels]
STRIDE = 2  # control steps per frame; a gif has half the frames at half the size
TEXT_COLORS = {"plain": (255, 255, 255), "command": (110, 240, 130), "velocity": (130, 190, 255)}
BOX_COLOR = (20, 24, 30, 190)

Row = tuple[str, list[str]]  # a row of text: a key of TEXT_COLORS, and words
Step = Sequence[np.ndarray]
"""Robots after a control step: positions of the joints, (robots, nq); v_x, v_y [m/s] and yaw rate [rad/s] as commanded,
(robots, 3), and of the trunk in its own frame, (robots, 3)."""


class VideoRecorder:
    """Collects the motion of robots and draws it as a video in real time.

    A green arrow is the commanded velocity, a blue one the actual velocity; numbers show both. Several robots are the
    tiles of a grid, row by row.

    Attributes:
        drawing: One robot with its ground. The size of its model's off-screen buffer is changed.
        steps: The robots after each control step; their number is a square number.
    """

    def __init__(self, drawing: Drawing, control_step: float) -> None:
        """Start without steps, which last ``control_step`` [s]."""
        self.drawing, self._control_step = drawing, control_step
        self.steps: list[Step] = []

    def save(self, file: Path, no_renderer: str | None) -> bool:
        """Write the video and print its place, or print why there is none; ``no_renderer`` is one such reason.

        Returns whether there is one.
        """
        try:
            self.write(file, no_renderer)
            print(f"video: {file}")
            return True
        except UserError as error:
            print(f"no video: {error}")
            return False

    def write(
        self, file: Path, no_renderer: str | None, on_frame: Callable[[int, int], None] = lambda number, total: None
    ) -> None:
        """Write the video; a UserError if there is no renderer, for a known reason or another, or no encoder.

        ``on_frame`` is called after each frame with its number and the number of all.
        """
        if no_renderer or not self.steps:
            raise UserError(no_renderer or "nothing has moved")
        require("imageio", "imageio_ffmpeg", "PIL", extra="video")
        import imageio

        side = math.isqrt(len(self.steps[0][0]))
        width, height = SIZE if side == 1 else (length // side // 2 * 2 for length in GRID_SIZE)  # even, for mp4
        drawing, model = self.drawing, self.drawing.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        try:
            renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # whatever the graphics driver raises
            raise UserError(f"the renderer does not start: {error} ({INSTALL_HINT})") from None
        cameras = [Camera(drawing.ground, drawing.size) for _ in range(side**2)]
        is_gif = file.suffix.lower() == ".gif"  # whose frames of 10 ms or less browsers show for 100 ms
        stride = max(STRIDE, math.ceil(0.02 / self._control_step - 1e-6)) if is_gif else STRIDE
        shown = list(enumerate(self.steps, start=1))[::stride]
        with tempfile.TemporaryDirectory() as folder:
            part = Path(folder) / file.name
            frame_step = stride * self._control_step
            timing: dict[str, Any] = {"fps": 1.0 / frame_step, "macro_block_size": 1}
            if is_gif:
                timing = {"duration": gif_durations(len(shown), frame_step)}
            writer = imageio.get_writer(part, **timing)
            with renderer, writer, Counter("rendering, frame", len(shown)) as counter:
                for frame, (number, step) in enumerate(shown, start=1):
                    seconds, tiles = number * self._control_step, []
                    for camera, qpos, *vectors in zip(cameras, *step, strict=True):
                        drawing.move(qpos)
                        renderer.update_scene(drawing.data, camera.look_at(drawing.data.xpos[drawing.trunk]))
                        drawing.add_velocities(renderer.scene, *vectors)
                        rows = speed_rows(*vectors) if side > 1 else velocity_rows(seconds, *vectors)
                        tiles.append(add_text(renderer.render(), rows))
                    writer.append_data(np.vstack([np.hstack(tiles[i : i + side]) for i in range(0, len(tiles), side)]))
                    counter.add()
                    on_frame(frame, len(shown))
            write_whole(file, part.read_bytes())


class SimulationRecorder(VideoRecorder):
    """Records the robot of :mod:`legged_torque.deploy.simulation`."""

    def __init__(self, simulation: Simulation) -> None:
        """Prepare to record a simulation."""
        robot, description = simulation.robot, simulation.policy.description
        ground, model = None, robot.model
        if "terrain" in description and model.nhfield:
            ground = Ground(Layout(**description["terrain"]))
            model = drawn_model(robot.file, ground)
        super().__init__(Drawing(model, ground, robot.trunk), 1.0 / description["timing"]["control_frequency"])
        self._simulation = simulation

    def add_step(self) -> None:
        """Record the state after a control step."""
        simulation, robot = self._simulation, self._simulation.robot
        self.steps.append([np.array([row]) for row in (robot.data.qpos, simulation.command, robot.planar_velocity())])


class TaskRecorder(VideoRecorder):
    """Records worlds of a task."""

    def __init__(self, task: LeggedRobot, num_worlds: int = 1) -> None:
        """Prepare to record the first worlds of a task; a single one is that with the fastest command at the start."""
        super().__init__(Drawing.of_task(task), task.dt)
        self._task = task
        self._worlds = list(range(num_worlds)) if num_worlds > 1 else []

    def add_step(self) -> None:
        """Record the state after a control step."""
        task = self._task
        self._worlds = self._worlds or [int(task.commands[:, :2].norm(dim=1).argmax())]
        tensors = (task.sim.qpos, task.commands, task.state.planar_velocity())
        self.steps.append([tensor[self._worlds].double().cpu().numpy() for tensor in tensors])


def show_in_tensorboard(video: Path, iterations: int) -> None:
    """Add a video as a gif to the images of a run in tensorboard, as events in the video's folder."""
    import imageio.v3
    from tensorboard.compat.proto.summary_pb2 import Summary
    from torch.utils.tensorboard.writer import FileWriter

    shown = itertools.islice(imageio.v3.imiter(video, plugin="FFMPEG"), None, None, STRIDE)
    frames = np.stack([frame[::2, ::2].copy() for frame in shown])
    duration = gif_durations(len(frames), STRIDE / imageio.v3.immeta(video, plugin="FFMPEG")["fps"])
    gif = imageio.v3.imwrite("<bytes>", frames, extension=".gif", duration=duration, loop=0)
    size = {"height": frames.shape[1], "width": frames.shape[2], "colorspace": 3}
    value = Summary.Value(tag="video", image=Summary.Image(**size, encoded_image_string=gif))
    writer = FileWriter(str(video.parent))
    writer.add_summary(Summary(value=[value]), iterations)
    writer.close()


def gif_durations(count: int, step: float) -> list[int] | int:
    """Return how long frames are shown [ms] that come every ``step`` [s], in whole 10 ms; a number for a single one."""
    durations = (10 * np.diff(np.round(100.0 * step * np.arange(count + 1)))).astype(int).tolist()
    return durations if count > 1 else durations[0]


def velocity_rows(time: float, command: np.ndarray, velocity: np.ndarray) -> list[Row]:
    """Return the text of a single robot: time [s], command, velocity."""
    rounded = (np.round(row, 2) + 0.0 for row in (command, velocity))  # no -0.00
    wanted, actual = ([f"{value:+.2f}" for value in row] for row in rounded)
    return [
        ("plain", [f"{time:.2f} s", "v_x", "v_y", "yaw"]),
        ("command", ["command", *wanted]),
        ("velocity", ["actual", *actual]),
        ("plain", ["", "m/s", "m/s", "rad/s"]),
    ]


def speed_rows(command: np.ndarray, velocity: np.ndarray) -> list[Row]:
    """Return the short text of a tile: horizontal speeds, commanded and actual."""
    wanted, actual = (f"{np.linalg.norm(vector[:2]):.2f} m/s" for vector in (command, velocity))
    return [("command", ["command", wanted]), ("velocity", ["actual", actual])]


def add_text(image: np.ndarray, rows: list[Row]) -> np.ndarray:
    """Return an image with rows of text in its upper left corner. Shape: (height, width, 3), 8 bits.

    The first word of a row is left-aligned, the others are right-aligned.
    """
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture, "RGBA")
    size = max(11, picture.height // 22)  # of letters [pixels]; all places below are multiples of it
    font, num_columns = ImageFont.load_default(size), len(rows[0][1])
    step = 3.4 if num_columns > 2 else 4.7
    ends = [5.3 + step * column for column in range(num_columns)]  # right ends of the columns
    box = (0.4, 0.4, ends[-1] + 0.6, 0.9 + 1.3 * len(rows))
    draw.rectangle([size * place for place in box], fill=BOX_COLOR)
    for i, (color, (name, *words)) in enumerate(rows):
        y = (1.65 + 1.3 * i) * size
        draw.text((0.9 * size, y), name, TEXT_COLORS[color], font, anchor="ls")
        for word, end in zip(words, ends[1:], strict=True):
            draw.text((end * size, y), word, TEXT_COLORS[color], font, anchor="rs")
    return np.asarray(picture)
