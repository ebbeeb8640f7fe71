"""A page that shows and steers a session: ``play.py --viewer web``."""

import functools
import html
import json
import math
import os
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import viser
from viser._messages import RunJavascriptMessage

from legged_torque.utils.errors import UserError
from legged_torque.utils.interrupt import StopRequest
from legged_torque.utils.policies import policy_names
from legged_torque.viewer.access import TOKEN, GuardedServer
from legged_torque.viewer.drawing import Drawing, Ground
from legged_torque.viewer.plots import WIDTH, Plots
from legged_torque.viewer.scene import Scene
from legged_torque.viewer.session import AS_LOADED, FASTEST, SLOWEST, Command, Session
from legged_torque.viewer.video import VideoRecorder

FRAME_INTERVAL = 1.0 / 30.0  # seconds between drawings of the robots
PLOT_INTERVAL = 0.2  # seconds between drawings of the plots and the status
COLOR = (47, 125, 246)  # of controls
MAX_SECONDS = 60.0  # of a video
RECORD, STOP = "Record", "Stop and download"  # labels of the button
PUSHES = {"from behind": 0.0, "from the right": 90.0, "from the front": 180.0, "from the left": -90.0}
"""Directions of pushes from the robot's heading to its left [degrees]."""
STEP = 0.05  # of the sliders of commands [m/s, rad/s] and weights
FAREWELL_SECONDS = 0.5  # in which browsers get the last message
KEYS = """<div class="lt-keys">or hold W A S D, arrows, or a gamepad's sticks<br>
    0 stand still, space pause, R reset, P push</div>"""
COMMANDS = {"v_x [m/s]": "forward", "v_y [m/s]": "to the left", "yaw rate [rad/s]": "turning to the left"}
VIEW = {
    "follow": ("camera follows", True, "keeps the followed robot in view"),
    "others": ("all worlds", True, "draw the other worlds too"),
    "contacts": ("contacts", True, "points and forces, 1 m for 500 N"),
    "collision": ("collision geoms", False, "what touches the ground in the simulator"),
    "ghost": ("ghost", False, "where the commands of the last second lead"),
    "scan": ("height scan", True, "where the ground is measured"),
}
"""What is drawn, by name: label, whether it is at first, hint."""


class Page:
    """Shows a session, and turns what users change in the right panel into requests to it.

    Everything is drawn in a thread of its own, which never touches the task's tensors. If drawing fails, the error is
    shown on the page, and everything else goes on.

    Attributes:
        server: Of viser, at its address ``url``.
        status: Text above the controls.
        errors: Of the page itself, in red; hidden if there are none.
    """

    def __init__(self, session: Session, title: str, host: str, port: int, no_renderer: str | None = None) -> None:
        """Serve the page at a port or the next free one; ``no_renderer`` is a reason why no videos can be drawn."""
        self._session, self._no_renderer = session, no_renderer
        self.server = GuardedServer(host, port, title)
        gui, drawing = self.server.gui, Drawing.of_task(session.task)
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=COLOR)
        self._gui, self._ground = gui, drawing.ground
        self._scene = Scene(self.server, session, drawing)
        self._shown: list[tuple[Any, str, Callable[[], Any]]] = []  # controls, attributes of theirs, and their values
        self.status, self.errors = gui.add_html(""), gui.add_html("", visible=False)
        self._errors: dict[str, str] = {}  # by part of the page or control
        self._keys: dict[str, viser.GuiInputHandle] = {}  # controls that keys press, by the names of keys in browsers
        self._add_controls()
        self._plots = Plots(gui, session)
        self._recorder: VideoRecorder | None = None
        hint = f"a video of the followed robot, up to {MAX_SECONDS:.0f} s"
        self._record = self._add_button(RECORD, viser.Icon.VIDEO, hint, self._start_or_end_recording)
        self._add_script()
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)
        self._thread.start()

    def close(self, farewell: str = "") -> None:
        """Stop drawing and serving; a farewell stays in the browsers."""
        self._closed.set()
        self._thread.join(timeout=2.0)
        for client in self.server.get_clients().values() if farewell else ():
            client.add_notification("The viewer has ended", farewell, color="red")
        time.sleep(FAREWELL_SECONDS if farewell else 0.0)
        self.server.stop()

    def _run(self) -> None:
        """Draw until closed; plots, controls and status less often than the robots."""
        next_plots = 0.0
        while not self._closed.wait(FRAME_INTERVAL):
            self._attempt("scene", lambda: self._scene.update({name for name, box in self._boxes.items() if box.value}))
            self._attempt("recording", self._record_steps)
            if time.perf_counter() >= next_plots:
                next_plots = time.perf_counter() + PLOT_INTERVAL
                with self.server.atomic():
                    self._attempt("plots", self._plots.update)
                    self._attempt("controls", self._update_controls)
                    self._attempt("status", self._draw_status)
                    lines = [html.escape(error) for error in list(self._errors.values())]
                    self.errors.content = f'<div class="lt-status lt-error">{"<br>".join(lines)}</div>'
                    self.errors.visible = bool(lines)

    def _attempt(self, part: str, action: Callable[[], None]) -> None:
        """Draw a part of the page, or do what a control asks for; an error is shown until that has worked again."""
        try:
            action()
            self._errors.pop(part, None)
        except UserError as error:
            self._errors[part] = str(error)
        except Exception as error:
            text = f"{part}: {type(error).__name__}: {error}"
            if self._errors.get(part) != text:
                self._errors[part] = text
                traceback.print_exc()

    def _update_controls(self) -> None:
        """Show the session's values, unless a choice has not been carried out yet."""
        if any(session and session.requests for session in (self._session, self._session.companion)):
            return
        for control, attribute, value in self._shown:
            now = value()
            if isinstance(control, viser.GuiSliderHandle):
                now = round(now, 2)  # other sliders command what this one shows: its range must contain the value
                control.min, control.max = min(control.min, now), max(control.max, now)
            if getattr(control, attribute) != now:  # each change is a message to the browsers
                setattr(control, attribute, now)

    def _draw_status(self) -> None:
        """Write checkpoint, time, companion, tile on rough ground, message, and an error of the companion."""
        session, messages = self._session, [self._session.message]
        running = "paused" if session.is_paused else f"{session.pacer.rate:.2f} x real time"
        lines = [
            f"<b>model_{session.checkpoint}</b>, after {session.trained_steps / 1e6:,.1f} million steps",
            f"{session.sim_time:.1f} s simulated, {running}, {session.falls} falls",
        ]
        if other := session.companion:
            lines.append(f"companion: <b>{html.escape(other.name)}</b>, model_{other.checkpoint}, {other.falls} falls")
            messages += [other.message] if other.message.is_error else []
        if self._ground and session.snapshot and session.snapshot.tile:
            lines.append(self._ground.tile_text(*session.snapshot.tile))
        for message in messages:
            kind = "lt-error" if message.is_error else ""
            lines.append(f'<span class="{kind}">{html.escape(message.text) or "&nbsp;"}</span>')
        self.status.content = f'<div class="lt-status">{"<br>".join(lines)}</div>'

    # ---- controls ----------------------------------------------------------------------------------------------------

    def _add_controls(self) -> None:
        """Add all controls."""
        gui, session = self._gui, self._session
        with gui.add_folder("Command"):
            self._add_command()
        if session.policy:
            hint = "another robot or another way to control it; comes in some seconds"
            policy = gui.add_dropdown("policy", policy_names(), hint=hint)
            self._bind(policy, lambda: session.chosen or session.policy, session.stop)
        with gui.add_folder("Time"):
            pause = gui.add_checkbox("pause", False, hint="stop all robots; controls take effect at once")
            self._bind(pause, lambda: session.is_paused, session.set_paused)
            self._keys["Space"] = pause
            speed = gui.add_slider("speed [x]", SLOWEST, FASTEST, 0.1, FASTEST, hint="1 is real time")
            self._bind(speed, lambda: session.pacer.speed, session.set_speed)
            hint = "a new episode in every world"
            self._keys["KeyR"] = self._add_button("Reset", viser.Icon.ROTATE, hint, session.reset)
        with gui.add_folder("Push"):
            direction = gui.add_dropdown("direction", tuple(PUSHES), hint="where it comes from, seen by the robot")
            hint = "added to the trunk's velocity at once"
            strength = gui.add_slider("strength [m/s]", 0.1, 2.0, 0.1, 0.8, hint=hint)
            icon, hint = viser.Icon.ARROW_BIG_RIGHT, "pushes the robots of all worlds"
            self._keys["KeyP"] = self._add_button(
                "Push", icon, hint, lambda: session.push(math.radians(PUSHES[direction.value]), strength.value)
            )
        with gui.add_folder("Run"):
            self._add_checkpoint("checkpoint", session)
            newest = gui.add_checkbox("follow training", False, hint="load each new checkpoint as soon as it is saved")
            self._bind(newest, lambda: session.follows_newest, session.follow_newest)
            if session.companion:
                self._add_checkpoint("companion", session.companion)
            hint = "random parameters, pushes and noise; rebuilds the worlds"
            perturbation = gui.add_dropdown("perturbation", (AS_LOADED, *session.task.cfg.perturbations()), hint=hint)
            self._bind(perturbation, lambda: session.perturbation, session.set_perturbation)
        if session.mixing:
            with gui.add_folder("Mixing weights"):
                automatic = gui.add_checkbox("as in training", True, hint="the weights at this point of the training")
                names, hint = [name.replace("_", " ") for name in session.mixing], "factor on this part of the torques"
                sliders = [gui.add_slider(name, 0.0, 1.0, STEP, 0.0, hint=hint) for name in names]
                values = (lambda: list(session.mixing.values()), automatic, lambda: session.chosen_mixing is None)
                self._bind_sliders(sliders, *values, session.set_mixing)
        if self._ground:
            with gui.add_folder("Tile"):
                self._add_tile(self._ground)
        with gui.add_folder("View"):
            self._add_view()

    def _bind(self, control: viser.GuiInputHandle, value: Callable[[], Any], request: Callable[[Any], None]) -> None:
        """Show a value of the session in a control, and request what users choose."""
        self._shown.append((control, "value", value))

        @control.on_update
        async def choose(event: viser.GuiEvent) -> None:  # at once: a function would run after values are shown again
            if event.client:  # a user has changed it
                self._attempt(control.label, lambda: request(control.value))

    def _add_button(self, label: str, icon: Any, hint: str, action: Callable[[], None]) -> viser.GuiButtonHandle:
        """Add a button."""
        button = self._gui.add_button(label, icon=icon, hint=hint)
        button.on_click(lambda event: self._attempt(label, action))
        return button

    def _bind_sliders(
        self,
        sliders: Sequence[viser.GuiInputHandle],
        values: Callable[[], Sequence[float]],
        automatic: viser.GuiInputHandle,
        is_automatic: Callable[[], bool],
        request: Callable[[Any], None],
    ) -> None:
        """Request the values of sliders, or None when a checkbox is ticked."""

        def choose(value: object) -> None:
            request(tuple(slider.value for slider in sliders))

        self._bind(automatic, is_automatic, lambda value: request(None) if value else choose(value))
        for place, slider in enumerate(sliders):
            self._bind(slider, functools.partial(lambda place: values()[place], place), choose)

    def _add_command(self) -> None:
        """Add the commanded velocities. Moving a slider ends random commands."""
        gui, session, ranges = self._gui, self._session, self._session.task.cfg.commands.ranges
        random = gui.add_checkbox("random", True, hint="as in training, for each world")
        trained = (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw)
        limits = [(min(low, 0.0), max(high, 0.0)) for low, high in trained]
        sliders = [
            gui.add_slider(label, low, max(high, low + STEP), STEP, 0.0, hint=hint)
            for (label, hint), (low, high) in zip(COMMANDS.items(), limits, strict=True)
        ]

        def command() -> Sequence[float]:
            drawn = session.snapshot.commands[session.world].tolist() if session.snapshot else (0.0, 0.0, 0.0)
            return session.command or drawn

        def steer(shares: Command) -> None:
            pairs = zip(limits, shares, strict=True)
            x, y, yaw = (share * (high if share > 0.0 else -low) for (low, high), share in pairs)
            session.set_command((x, y, yaw))

        self._bind_sliders(sliders, command, random, lambda: session.command is None, session.set_command)
        gui.add_html(KEYS)
        hint = "the command 0 for all robots"
        low, none, high = (-1.0, -1.0, -1.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
        self._keys["Digit0"] = self._add_button("Stand still", viser.Icon.HAND_STOP, hint, lambda: steer(none))
        self._field = field = gui.add_vector3("steering", none, min=low, max=high, visible=False)

        @field.on_update
        async def changed(event: viser.GuiEvent) -> None:  # viser calls coroutines in the order of the changes
            self._attempt("steering", lambda: steer(field.value))

    def _add_script(self) -> None:
        """Let browsers run page.js, with the field that held keys and sticks set, the controls of keys, and hints."""
        controls = self._gui._gui_input_handle_from_uuid
        page = {
            "field": self._field._impl.uuid,
            "controls": {key: control._impl.uuid for key, control in self._keys.items()},
            "hints": {uuid: control.hint for uuid, control in controls.items()},
        }
        script = f"const page = {json.dumps(page)};\n{Path(__file__).with_name('page.js').read_text()}"
        self._gui._websock_interface.queue_message(RunJavascriptMessage(script))  # as viser itself does for Plotly

    def _add_checkpoint(self, label: str, session: Session) -> None:
        """Add the choice of a session's checkpoint."""
        hint = "iterations of the training after which the policy was saved"
        control = self._gui.add_dropdown(label, (str(session.checkpoint),), hint=hint)

        def options() -> tuple[str, ...]:
            return tuple(map(str, sorted({*session.checkpoints, session.checkpoint})))

        def choose(value: str) -> None:
            session.follow_newest(False)
            session.load_checkpoint(int(value))

        self._shown.append((control, "options", options))
        self._bind(control, lambda: str(session.checkpoint), choose)

    def _add_tile(self, ground: Ground) -> None:
        """Add the tile of the followed robot."""
        gui, session, kinds, last = self._gui, self._session, ground.layout.kinds(), ground.layout.num_rows - 1
        kind = gui.add_dropdown("kind", tuple(dict.fromkeys(kinds)), hint="moves the followed robot onto such a tile")
        level = gui.add_slider("level", 0, max(last, 1), 1, 0, hint="the first is the easiest", disabled=last == 0)

        def tile() -> tuple[int, int]:
            return (session.snapshot and session.snapshot.tile) or (0, 0)

        def move(value: object) -> None:
            session.set_tile(level.value, kinds.index(kind.value))

        self._bind(kind, lambda: kinds[tile()[1]], move)
        self._bind(level, lambda: tile()[0], move)

    def _add_view(self) -> None:
        """Add the followed world and what is drawn."""
        gui, session, num_envs = self._gui, self._session, self._session.task.num_envs
        if num_envs > 1:
            world = gui.add_dropdown("world", tuple(map(str, range(num_envs))), hint="the robot of camera and plots")
            self._bind(world, lambda: str(session.world), lambda value: session.follow_world(int(value)))
        is_needed = {"others": num_envs > 1, "scan": self._ground is not None}
        self._boxes = {
            name: gui.add_checkbox(label, is_on, hint=hint, visible=is_needed.get(name, True))
            for name, (label, is_on, hint) in VIEW.items()
        }

    # ---- videos of the followed robot --------------------------------------------------------------------------------

    def _start_or_end_recording(self) -> None:
        """Start, or end and draw in a thread of its own."""
        if self._recorder:
            send, self._recorder = functools.partial(self._send_video, self._recorder), None
            threading.Thread(target=self._attempt, args=("video", send), name="recording", daemon=True).start()
        else:
            self._recorded = self._session.sim_time  # time of the last step that has been recorded [s]
            self._recorder = VideoRecorder(Drawing.of_task(self._session.task), self._session.task.dt)
            self._record.label = STOP

    def _record_steps(self) -> None:
        """Record the new steps of the session."""
        recorder = self._recorder
        if recorder:
            for one in (one for one in list(self._session.history) if one.time > self._recorded):
                recorder.steps.append((one.qpos[[one.world]], one.commands[[one.world]], one.velocities[[one.world]]))
                self._recorded = one.time
            if len(recorder.steps) * self._session.task.dt > MAX_SECONDS:
                self._start_or_end_recording()

    def _send_video(self, recorder: VideoRecorder) -> None:
        """Draw a video and send it to the browsers; a UserError says why there is none."""

        def show_progress(frame: int, total: int) -> None:
            self._record.label = f"Drawing frame {frame} of {total}"

        self._record.disabled = True
        try:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "walking.mp4"
                recorder.write(file, self._no_renderer, show_progress)
                self.server.send_file_download(file.name, file.read_bytes(), save_immediately=True)
        finally:
            self._record.label, self._record.disabled = RECORD, False


def watch(session: Session, title: str, host: str, port: int, again: str, no_renderer: str | None = None) -> int:
    """Serve a :class:`Page`, step until Ctrl-C, and return the port; ``again`` is the command that opens it again."""
    page = Page(session, title, host, port, no_renderer)
    if page.server.get_port() != port:
        print(f"Port {port} is taken.")
    if page.server.token:
        print("Warning: other machines reach this page, unencrypted; whoever has its address can steer the robots.")
    print(f"See it walk: {page.server.url} (Ctrl-C ends)", flush=True)
    try:
        with StopRequest(lambda text: session.stop()):
            session.run()
    finally:
        ended = f"If a training has started it, that has ended, too. Open the viewer again with: {again}"
        page.close(f"{session.chosen} comes in some seconds." if session.chosen else ended)
    os.environ[TOKEN] = page.server.token  # browsers know no other one if another policy comes
    return page.server.get_port()
