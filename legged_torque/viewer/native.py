"""MuJoCo's own window, for a session (``play.py --viewer native``) or a simulation (``sim2sim.py --viewer``).

Needs neither torch nor Warp.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco

from legged_torque.deploy.simulation import Simulation
from legged_torque.utils.errors import UserError
from legged_torque.viewer.arrows import add_velocities
from legged_torque.viewer.framing import TRUNK, size_of
from legged_torque.viewer.ground import Ground, drawn_model, ground_of
from legged_torque.viewer.pacing import Pacer, stopping_on_ctrl_c
from legged_torque.viewer.state import SessionState

if TYPE_CHECKING:
    from legged_torque.viewer.session import Session

KEYS = """Keys: arrows up/down  v_x    arrows left/right  yaw rate    comma/period  v_y    0  stand still
      space  pause           R  reset                       P  push         Esc or Ctrl-C  end"""
STEP = 0.1  # change of a command per key press [m/s or rad/s]
FRAME_INTERVAL = 1.0 / 60.0  # seconds between drawings
PUSH_SPEED, PUSH_ANGLE = 0.8, 1.5708  # a push: speed [m/s] and direction from the robot's front, to its left [rad]

_SPACE, _COMMA, _PERIOD, _ZERO, _P, _R = 32, 44, 46, 48, 80, 82
_RIGHT, _LEFT, _DOWN, _UP = 262, 263, 264, 265
_COMMAND_KEYS = ((_UP, _DOWN), (_COMMA, _PERIOD), (_LEFT, _RIGHT))  # keys of GLFW that raise and lower each command


def check_display(instead: str) -> None:
    """Raise a UserError, which tells what works instead, if there is no screen to open a window on."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError(f"MuJoCo's window needs a screen; {instead} works without one")
    if sys.platform == "darwin" and not sys.argv[0].endswith("mjpython"):
        raise UserError(f"MuJoCo's window needs mjpython in place of python on macOS; {instead} does not")
    if sys.platform != "darwin":
        import glfw

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if not glfw.init():  # MuJoCo would wait for its window forever
                raise UserError(f"MuJoCo's window cannot be opened on this screen; {instead} works without one")
        glfw.terminate()


class Keyboard:
    """Turns keys into requests. Keys come from the window's thread."""

    def __init__(self, session: Session) -> None:
        """Start with the command 0 in place of random ones."""
        self._session = session
        self._is_paused = False
        ranges = session.task.cfg.commands.ranges
        self._limits = [ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw]
        self._set_command(0.0, 0.0, 0.0)

    def _set_command(self, x: float, y: float, yaw: float) -> None:
        """Ask for a command."""
        self._command = [x, y, yaw]
        self._session.set_command((x, y, yaw))

    def press(self, key: int) -> None:
        """Ask for what a key means; ``key`` is its code of GLFW."""
        for index, keys in enumerate(_COMMAND_KEYS):
            if key in keys:
                change = STEP if key == keys[0] else -STEP
                low, high = self._limits[index]
                self._command[index] = round(min(max(self._command[index] + change, low), high), 3)
                self._set_command(*self._command)
        if key == _ZERO:
            self._set_command(0.0, 0.0, 0.0)
        elif key == _SPACE:
            self._is_paused = not self._is_paused
            self._session.set_paused(self._is_paused)
        elif key == _R:
            self._session.reset()
        elif key == _P:
            self._session.push(PUSH_ANGLE, PUSH_SPEED)


def watch(session: Session, robot: Path) -> None:
    """Show the first world until the window is closed, or until Ctrl-C; the session steps in a thread of its own."""
    import mujoco.viewer  # needs a screen

    ground = ground_of(session.task)
    model = drawn_model(robot, ground, session.task.dof_names)
    data = mujoco.MjData(model)
    keyboard = Keyboard(session)
    print(KEYS, flush=True)
    before = set(threading.enumerate())
    hidden = {"show_left_ui": False, "show_right_ui": False}
    window = mujoco.viewer.launch_passive(model, data, key_callback=keyboard.press, **hidden)
    drawing = set(threading.enumerate()) - before
    with window:
        window.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        window.cam.trackbodyid = TRUNK
        size = size_of(model)
        window.cam.distance, window.cam.azimuth, window.cam.elevation = 1.8 * size, 130.0, -18.0
        stepping = threading.Thread(target=session.run, name="session")  # drawing must not hold up the steps
        stepping.start()
        with stopping_on_ctrl_c(session.stop):
            while window.is_running() and stepping.is_alive():
                draw(session.state, window, model, data, size, ground)
                stepping.join(FRAME_INTERVAL)
            session.stop()
            stepping.join()
    for thread in drawing:
        thread.join(timeout=5.0)  # Python would crash if it ended while the window still draws


def draw(
    state: SessionState,
    window: mujoco.viewer.Handle,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    size: float,
    ground: Ground | None = None,
) -> None:
    """Show the first world, and its command, velocity and tile as text; the window draws ``data``."""
    if state.reading is None:
        return
    command, velocity = state.reading.commands[0], state.reading.velocities[0]
    with window.lock():
        window.opt.geomgroup[0] = 1  # MuJoCo's own key 0 hides this group, which contains the floor
        data.qpos[:] = state.reading.qpos[0]
        mujoco.mj_forward(model, data)
        window.user_scn.ngeom = 0
        add_velocities(window.user_scn, data, TRUNK, command, velocity, size)
    names = ("v_x [m/s]", "v_y [m/s]", "yaw [rad/s]")
    rows = [f"{wanted:+.2f}   {actual:+.2f}" for wanted, actual in zip(command, velocity, strict=True)]
    running = "paused" if state.is_paused else f"{state.real_time:.2f} x real time"
    labels, values = ["", *names, f"model_{state.checkpoint}"], ["commanded, actual", *rows, running]
    if ground:
        labels.append("tile")
        values.append(ground.tile_text(*state.reading.tile.astype(int)))
    window.set_texts((None, None, "\n".join(labels), "\n".join(values)))
    window.sync()


@contextlib.contextmanager
def simulation_window(simulation: Simulation) -> Iterator[Callable[[], None]]:
    """Open a window on a simulation; what is returned shows the state after a control step, in real time."""
    check_display("--video")
    import mujoco.viewer  # needs a screen

    pacer = Pacer(1.0 / simulation.policy.description["timing"]["control_frequency"])
    with mujoco.viewer.launch_passive(simulation.robot.model, simulation.robot.data) as window:

        def show() -> None:
            if not window.is_running():
                raise KeyboardInterrupt  # closing the window counts as Ctrl-C
            window.sync()
            pacer.wait()

        yield show
