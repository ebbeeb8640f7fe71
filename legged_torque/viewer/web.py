"""A page that shows and steers a session: ``play.py --viewer web``."""

from __future__ import annotations

import html
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import viser

from legged_torque.utils.errors import UserError
from legged_torque.utils.interrupt import StopRequest
from legged_torque.viewer.access import GuardedServer
from legged_torque.viewer.controls import Controls
from legged_torque.viewer.drawing import Drawing
from legged_torque.viewer.plots import WIDTH, Plots
from legged_torque.viewer.scene import Scene
from legged_torque.viewer.session import Session
from legged_torque.viewer.video import VideoRecorder

FRAME_INTERVAL = 1.0 / 30.0  # seconds between drawings of the robots
PLOT_INTERVAL = 0.2  # seconds between drawings of the plots and the status
COLOR = (47, 125, 246)  # of controls
NOTICE_SECONDS = 10.0  # for which notifications are shown
MAX_SECONDS = 60.0  # of a video
RECORD, STOP = "Record", "Stop and download"  # labels of the button


class Page:
    """Draws a session in a thread of its own, which never touches the task's tensors.

    If drawing fails, the error is shown on the page, and everything else goes on.

    Attributes:
        server: Of viser, at its address ``url``.
        controls: The right panel.
    """

    def __init__(self, session: Session, title: str, host: str, port: int, no_renderer: str | None = None) -> None:
        """Serve the page at a port or the next free one; ``no_renderer`` is a reason why no videos can be drawn."""
        self._session, self._no_renderer = session, no_renderer
        self.server = GuardedServer(host, port, title)
        gui, drawing = self.server.gui, Drawing.of_task(session.task)
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=COLOR)
        self._ground = drawing.ground
        self._scene = Scene(self.server, session, drawing)
        self.controls = Controls(gui, session, drawing.ground)
        self._plots = Plots(gui, session)
        self._recorder: VideoRecorder | None = None
        hint = f"up to {MAX_SECONDS:.0f} s of the followed robot"
        self._record = gui.add_button(RECORD, icon=viser.Icon.VIDEO, hint=hint)
        self._record.on_click(lambda event: self._start_or_end_recording())
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)
        self._errors: dict[str, str] = {}  # of the last drawing, by part of the page
        self._message_shown = session.message
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop drawing and serving."""
        self._closed.set()
        self._thread.join(timeout=2.0)
        self.server.stop()

    def _run(self) -> None:
        """Draw until closed; plots, controls and status less often than the robots."""
        next_plots = 0.0
        while not self._closed.wait(FRAME_INTERVAL):
            self._attempt("scene", lambda: self._scene.update(self.controls.drawn()))
            self._attempt("recording", self._record_steps)
            if time.perf_counter() >= next_plots:
                next_plots = time.perf_counter() + PLOT_INTERVAL
                with self.server.atomic():
                    self._attempt("plots", self._plots.update)
                    self._attempt("controls", self.controls.update)
                    self._attempt("status", self._draw_status)

    def _attempt(self, part: str, draw: Callable[[], None]) -> None:
        """Draw a part of the page; an error is shown until it has been drawn again."""
        try:
            draw()
            self._errors.pop(part, None)
        except Exception as error:
            text = f"{part}: {type(error).__name__}: {error}"
            if self._errors.get(part) != text:
                self._errors[part] = text
                traceback.print_exc()

    def _draw_status(self) -> None:
        """Write checkpoint, time, companion, tile on rough ground, errors and message; notify of a new error."""
        session, message = self._session, self._session.message
        running = "paused" if session.is_paused else f"{session.pacer.rate:.2f} x real time"
        lines = [
            f"<b>model_{session.checkpoint}</b>, after {session.trained_steps / 1e6:,.1f} million steps",
            f"{session.sim_time:.1f} s simulated, {running}, {session.falls} falls",
        ]
        if other := session.companion:
            lines.append(f"companion: <b>{html.escape(other.name)}</b>, model_{other.checkpoint}, {other.falls} falls")
        if self._ground and session.snapshot and session.snapshot.tile:
            lines.append(self._ground.tile_text(*session.snapshot.tile))
        texts = [*((error, True) for error in self._errors.values()), (message.text, message.is_error)]
        lines += [
            f'<span class="{"lt-error" * is_error}">{html.escape(text) or "&nbsp;"}</span>' for text, is_error in texts
        ]
        self.controls.status.content = f'<div class="lt-status">{"<br>".join(lines)}</div>'
        if message.is_error and message is not self._message_shown:
            self._notify("That did not work", message.text)
        self._message_shown = message

    def _notify(self, title: str, text: str) -> None:
        """Show an error in all browsers."""
        for client in self.server.get_clients().values():
            client.add_notification(title, text, color="red", auto_close_seconds=NOTICE_SECONDS)

    # ---- videos of the followed robot --------------------------------------------------------------------------------

    def _start_or_end_recording(self) -> None:
        """Start, or end and draw in a thread of its own."""
        if self._recorder:
            recorder, self._recorder = self._recorder, None
            threading.Thread(target=self._send_video, args=(recorder,), name="recording", daemon=True).start()
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
        """Draw a video and send it to the browsers, or show why there is none."""

        def show_progress(frame: int, total: int) -> None:
            self._record.label = f"Drawing frame {frame} of {total}"

        self._record.disabled = True
        try:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "walking.mp4"
                recorder.write(file, self._no_renderer, show_progress)
                self.server.send_file_download(file.name, file.read_bytes(), save_immediately=True)
        except Exception as error:  # the page goes on
            reason = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
            self._notify("There is no video", reason)
        finally:
            self._record.label, self._record.disabled = RECORD, False


def watch(session: Session, title: str, host: str, port: int, no_renderer: str | None = None) -> None:
    """Serve a :class:`Page` and step until Ctrl-C."""
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
        page.close()
