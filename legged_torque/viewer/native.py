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
from typing import TYPE_CHECKING

import mujoco

from legged_torque.deploy.simulation import Simulation
from legged_torque.utils.errors import UserError
from legged_torque.utils.interrupt import StopRequest
from legged_torque.viewer.drawing import AZIMUTH, ELEVATION, Drawing
from legged_torque.viewer.pacing import Pacer

if TYPE_CHECKING:
    from legged_torque.viewer.session import Session

KEYS = """Keys: arrows up/down  v_x    arrows left/right  yaw rate    comma/period  v_y    0  stand still
      space  pause           R  reset                       P  push         Esc or Ctrl-C  end"""
FRAME_INTERVAL = 1.0 / 60.0  # seconds between drawings
STEP = 0.1  # change of a command per key press [m/s or rad/s]
PUSH_SPEED, PUSH_ANGLE = 0.8, 1.5708  # of a push: speed [m/s], direction from the heading to the left [rad]
DISTANCE = 1.8  # of the camera, for the A1 [m]
CLOSE_TIMEOUT = 5.0  # seconds that MuJoCo's thread may take to end

COMMAND_KEYS = {265: (0, STEP), 264: (0, -STEP), 44: (1, STEP), 46: (1, -STEP), 263: (2, STEP), 262: (2, -STEP)}
"""Index in the command and its change, by GLFW's codes of up, down, comma, period, left and right."""
ACTIONS: dict[int, Callable[[Session], None]] = {
    ord(" "): lambda session: session.set_paused(not session.is_paused),
    ord("R"): lambda session: session.reset(),
    ord("P"): lambda session: session.push(PUSH_ANGLE, PUSH_SPEED),
}
STAND_STILL = ord("0")


def check_display(instead: str) -> None:
    """Raise a UserError that recommends ``instead`` if there is no screen for a window."""
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
    """Turns key presses in the window's thread into requests."""

    def __init__(self, session: Session) -> None:
        """Start with the session's command, or with the command 0 in place of random ones."""
        self._session = session
        ranges = session.task.cfg.commands.ranges
        self._limits = [ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw]
        session.carry_out_requests()  # the command line's command may be among them; nothing steps yet
        self._command = list(session.command or (0.0, 0.0, 0.0))
        if not session.command:
            self.press(STAND_STILL)

    def press(self, key: int) -> None:
        """Request the action of a key, given by its code of GLFW."""
        if key in ACTIONS:
            ACTIONS[key](self._session)
        elif key in COMMAND_KEYS:
            index, change = COMMAND_KEYS[key]
            low, high = self._limits[index]
            now = self._command[index]  # may be beyond the limits
            self._command[index] = round(min(max(now + change, min(low, now)), max(high, now)), 3)
        elif key == STAND_STILL:
            self._command = [0.0, 0.0, 0.0]
        if key in COMMAND_KEYS or key == STAND_STILL:
            v_x, v_y, yaw_rate = self._command
            self._session.set_command((v_x, v_y, yaw_rate))


def watch(session: Session) -> None:
    """Show the first world until the window is closed or Ctrl-C. The session steps in a thread of its own."""
    import mujoco.viewer  # needs a screen

    drawing, keyboard = Drawing.of_task(session.task), Keyboard(session)
    print(KEYS, flush=True)
    before = set(threading.enumerate())
    hidden = {"show_left_ui": False, "show_right_ui": False}
    window = mujoco.viewer.launch_passive(drawing.model, drawing.data, key_callback=keyboard.press, **hidden)
    of_window = set(threading.enumerate()) - before
    try:
        with window, StopRequest(lambda text: session.stop()):
            window.cam.type, window.cam.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, drawing.trunk
            window.cam.distance, window.cam.azimuth, window.cam.elevation = DISTANCE * drawing.size, AZIMUTH, -ELEVATION
            stepping = threading.Thread(target=session.run, name="session")  # drawing must not delay the steps
            stepping.start()
            while window.is_running() and stepping.is_alive():
                draw(session, window, drawing)
                stepping.join(FRAME_INTERVAL)
            session.stop()
            stepping.join()
    finally:
        for thread in of_window:
            thread.join(CLOSE_TIMEOUT)  # Python would crash if it ended while the window still draws


def draw(session: Session, window: mujoco.viewer.Handle, drawing: Drawing) -> None:
    """Show the first world by ``drawing``, whose data the window draws, and command, velocity and tile as text."""
    snapshot = session.snapshot
    if snapshot is None:
        return
    command, velocity = snapshot.commands[0], snapshot.velocities[0]
    with window.lock():
        window.opt.geomgroup[0] = 1  # MuJoCo's own key 0 hides this group, which contains the floor
        drawing.move(snapshot.qpos[0])
        window.user_scn.ngeom = 0
        drawing.add_velocities(window.user_scn, command, velocity)
    texts = {"": "commanded, actual"}
    for name, wanted, actual in zip(("v_x [m/s]", "v_y [m/s]", "yaw rate [rad/s]"), command, velocity, strict=True):
        texts[name] = f"{wanted:+.2f}   {actual:+.2f}"
    texts[f"model_{session.checkpoint}"] = "paused" if session.is_paused else f"{session.pacer.rate:.2f} x real time"
    if drawing.ground and snapshot.tile:
        texts["tile"] = drawing.ground.tile_text(*snapshot.tile)
    window.set_texts((None, None, "\n".join(texts), "\n".join(texts.values())))
    window.sync()


@contextlib.contextmanager
def simulation_window(simulation: Simulation) -> Iterator[Callable[[], None]]:
    """Open a window on a simulation and give a function that shows its state in real time, once per control step."""
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
