"""Videos: size and number of frames, the numbers in the corner, which worlds are drawn."""

import io
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

pytest.importorskip("PIL", reason="Pillow is not installed: pip install -e .[video]")

from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged_torque.viewer import video
from legged_torque.viewer.drawing import Drawing
from legged_torque.viewer.video import TaskRecorder

XML = Path(__file__).resolve().parents[2] / "resources" / "robots" / "a1" / "a1.xml"

DRAW = """
import sys
from pathlib import Path
from legged_torque.utils.devices import choose_offscreen_renderer
reason = choose_offscreen_renderer()
if reason:
    sys.exit("no renderer: " + reason)
import mujoco, numpy as np
from legged_torque.viewer.drawing import Drawing
from legged_torque.viewer.video import VideoRecorder
model = mujoco.MjModel.from_xml_path(sys.argv[1])
qpos = model.key_qpos[0] if model.nkey else model.qpos0
for robots, rate, ending in ((1, 75.0, "gif"), (4, 25.0, "mp4")):
    recorder, frames = VideoRecorder(Drawing(model), 1.0 / rate), []
    recorder.steps = 5 * [[np.tile(qpos, (robots, 1)), np.ones((robots, 3)), np.zeros((robots, 3))]]
    recorder.write(Path(sys.argv[2]) / f"{robots}.{ending}", None, lambda *frame: frames.append(frame))
    assert frames == [(1, 3), (2, 3), (3, 3)], frames
recorder.steps = 2 * [[row[:1] for row in recorder.steps[0]]]
recorder.write(Path(sys.argv[2]) / "2.gif", None)
recorder = VideoRecorder(Drawing(model), 0.005)
recorder.steps = 8 * [[np.tile(qpos, (1, 1)), np.ones((1, 3)), np.zeros((1, 3))]]
recorder.write(Path(sys.argv[2]) / "fast.gif", None)
"""


def test_frames(tmp_path):
    """A video has every second step in real time, maybe one; its size is that of all tiles, which all show a robot."""
    for package in ("imageio", "imageio_ffmpeg"):
        pytest.importorskip(package, reason=f"{package} is not installed: pip install -e .[video]")
    import imageio

    command = [sys.executable, "-c", DRAW, str(XML), str(tmp_path / "new")]
    # conftest.py tells MuJoCo not to render in this process, so another one draws
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    result = subprocess.run(command, capture_output=True, text=True, cwd=XML.parents[3], env=environment)
    if result.stderr.startswith("no renderer: "):
        pytest.skip(result.stderr.strip())
    assert (result.returncode, result.stderr) == (0, "")
    for side, width, height, ending in ((1, 960, 540, "gif"), (2, 1280, 720, "mp4")):
        file = tmp_path / "new" / f"{side**2}.{ending}"
        with imageio.get_reader(file) as reader:
            fps, frames = reader.get_meta_data().get("fps"), [np.asarray(frame) for frame in reader]
        assert [frame.shape for frame in frames] == [(height, width, 3)] * 3
        for rows in np.split(frames[-1], side):
            for tile in np.split(rows, side, axis=1):
                h, w = tile.shape[:2]
                assert tile[h // 3 : -h // 4, w // 3 : -w // 3].min() < 40 < 150 < tile.mean()  # black on light ground
    assert fps == 12.5  # of the mp4
    with Image.open(file.with_name("1.gif")) as picture:
        durations = [(picture.seek(i), picture.info["duration"])[1] for i in range(picture.n_frames)]
    assert durations == [30, 20, 30]  # [ms]: a gif counts hundredths of seconds
    with Image.open(file.with_name("2.gif")) as picture:
        assert (picture.n_frames, picture.size) == (1, (960, 540))
    with Image.open(file.with_name("fast.gif")) as picture:  # browsers show frames of 10 ms too long
        assert (picture.n_frames, picture.info["duration"]) == (2, 20)


def test_recorded_worlds(make_task):
    """One world is the fastest one, more are the first ones; what is kept is the task's state."""
    task = make_task("a1_torque", num_envs=5)
    task.reset()
    task.commands[:] = 0.1
    task.commands[3, 0] = -0.9
    one, four = TaskRecorder(task), TaskRecorder(task, 4)
    for _ in range(2):
        for recorder in (one, four):
            recorder.add_step()
        task.commands[:, 0] = 0.2  # the robot of the video stays the same
    for recorder, worlds in ((one, [3]), (four, [0, 1, 2, 3])):
        assert recorder.drawing.model.body(recorder.drawing.trunk).name == "trunk"
        for step, forward in zip(recorder.steps, (-0.9, 0.2), strict=True):
            qpos, command, velocity = step
            np.testing.assert_array_equal(qpos, task.sim.qpos[worlds].double().numpy())
            assert command[-1, 0] == pytest.approx(forward)
            np.testing.assert_allclose(velocity[:, :2], task.base_lin_vel[worlds, :2].numpy())
            np.testing.assert_allclose(velocity[:, 2], task.base_ang_vel[worlds, 2].numpy())


def test_arrows_of_velocities():
    """Commanded and actual velocity of a trunk that is turned to the left by a quarter; 0 has none."""
    body = "<body pos='0 0 1'><freejoint/><geom size='0.1'/></body>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    drawing, scene = Drawing(model), mujoco.MjvScene(model, 10)
    drawing.move(np.array([0.0, 0.0, 1.0, *np.sqrt([0.5, 0.0, 0.0, 0.5])]))
    drawing.add_velocities(scene, np.array([1.0, 0.0, 0.3]), np.array([0.0, 0.5, 0.0]))
    drawing.add_velocities(scene, np.zeros(3), np.zeros(3))
    ways = [geom.mat[:, 2] for geom in scene.geoms[: scene.ngeom]]
    np.testing.assert_allclose(ways, [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], atol=1e-6)
    assert scene.geoms[0].size[2] == pytest.approx(2.0 * scene.geoms[1].size[2])


def test_videos_in_tensorboard(tmp_path):
    """Every second frame at half the size, as moving pictures by the number of iterations."""
    imageio = pytest.importorskip("imageio", reason="the extra 'video' is not installed")
    pytest.importorskip("imageio_ffmpeg", reason="the extra 'video' is not installed")
    file = tmp_path / "model_7.mp4"
    with imageio.get_writer(file, fps=25, macro_block_size=1) as writer:
        for number in range(6):
            writer.append_data(np.full((64, 96, 3), 40 * number, np.uint8))
    for iterations in (7, 9):
        video.show_in_tensorboard(file, iterations)
    events = EventAccumulator(str(tmp_path)).Reload().Images("video")  # in the order of their files' names
    events = sorted(events, key=lambda event: event.step)
    assert (events[-1].step, events[-1].width, events[-1].height) == (9, 48, 32)
    picture = Image.open(io.BytesIO(events[-1].encoded_image_string))
    assert (picture.format, picture.n_frames, picture.info["duration"]) == ("GIF", 3, 80)
    picture.seek(2)
    assert np.asarray(picture.convert("RGB")).mean() == pytest.approx(160.0, abs=4.0)
