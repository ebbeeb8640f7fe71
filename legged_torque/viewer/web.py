"""A page that shows and steers a session: ``play.py --viewer web``."""

from __future__ import annotations

import html
import threading
import time
import traceback
from collections.abc import Callable

from legged_torque.utils.interrupt import StopRequest
from legged_torque.viewer.access import Guard, GuardedServer
from legged_torque.viewer.controls import Controls
from legged_torque.viewer.ground import Ground, drawn_task
from legged_torque.viewer.plots import WIDTH, Plots
from legged_torque.viewer.ports import free_port
from legged_torque.viewer.poses import commanded_pose
from legged_torque.viewer.recording import Recording, notify
from legged_torque.viewer.scene import Scene
from legged_torque.viewer.session import Session

FRAME_INTERVAL = 1.0 / 30.0  # seconds between drawings of the robots
PLOT_INTERVAL = 0.2  # seconds between drawings of the plots and the status
RED, COLOR = "#e03131", (47, 125, 246)  # of errors, of controls


class Page:
    """Draws a session in a thread of its own, which never touches the task's tensors.

    If drawing fails, the error is shown on the page, and everything else goes on.

    Attributes:
        guard: Decides who may use the page.
        server: Of viser.
        controls: The right panel.
    """

    def __init__(self, session: Session, title: str, host: str, port: int, no_renderer: str | None = None) -> None:
        """Serve the page at a port or the next free one; ``no_renderer`` is a reason why no videos can be drawn."""
        self._session, self.guard = session, Guard(host)
        self.server = GuardedServer(self.guard, host, free_port(host, port), title)
        gui, task, companion = self.server.gui, session.task, session.companion
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=COLOR)
        model, self._ground = drawn_task(task)
        names = (session.name, companion.name) if companion else ()
        self._scene = Scene(self.server, model, task.num_envs, task.asset.geom_names, self._ground, names)
        self.controls = Controls(gui, session, self._scene.view, self._ground)
        self._plots = Plots(gui, session)
        self._recording = Recording(self.server, session, no_renderer)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)
        self._errors: dict[str, str] = {}  # of the last drawing, by part of the page
        self._message_shown = session.message
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page for a browser on this machine, with the token if one is needed."""
        host, token = self.server.get_host(), self.guard.token
        address = f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{self.server.get_port()}"
        return f"{address}/?token={token}" if token else address

    def close(self) -> None:
        """Stop drawing and serving."""
        self._closed.set()
        self._thread.join(timeout=2.0)
        self.server.stop()

    def _run(self) -> None:
        """Draw until closed; plots, controls and status less often than the robots."""
        next_plots = 0.0
        while not self._closed.wait(FRAME_INTERVAL):
            self._attempt("scene", self._draw_scene)
            self._attempt("recording", self._recording.update)
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

    def _draw_scene(self) -> None:
        """Draw the robots."""
        session, snapshot = self._session, self._session.snapshot
        if snapshot:
            companion = session.companion.snapshot if session.companion else None
            ghost = commanded_pose(list(session.history) or [snapshot], session.task.dt)
            self._scene.update(snapshot, session.world, ghost, companion.qpos[0] if companion else None)

    def _draw_status(self) -> None:
        """Write the status, and show a new error of the session as a notification, too."""
        message = self._session.message
        self.controls.status.content = status_html(self._session, self._ground, list(self._errors.values()))
        if message.is_error and message is not self._message_shown:
            notify(self.server, "That did not work", message.text)
        self._message_shown = message


def status_html(session: Session, ground: Ground | None, errors: list[str]) -> str:
    """Return the status line by line: checkpoint, time, companion, tile on rough ground, errors, last message."""
    running = "paused" if session.is_paused else f"{session.real_time:.2f} x real time"
    lines = [
        f"<b>model_{session.checkpoint}</b>, after {session.trained_steps / 1e6:,.1f} million steps",
        f"{session.sim_time:.1f} s simulated, {running}, {session.falls} falls",
    ]
    if other := session.companion:
        lines.append(f"companion: <b>{html.escape(other.name)}</b>, model_{other.checkpoint}, {other.falls} falls")
    if ground and session.snapshot and session.snapshot.tile:
        lines.append(ground.tile_text(*session.snapshot.tile))
    lines += [f'<span style="color:{RED}">{html.escape(error)}</span>' for error in errors]
    color = RED if session.message.is_error else "inherit"
    lines.append(f'<span style="color:{color}">{html.escape(session.message.text) or "&nbsp;"}</span>')
    return f'<div style="font-size:13px;line-height:1.5;padding:4px 12px">{"<br>".join(lines)}</div>'


def watch(session: Session, title: str, host: str, port: int, no_renderer: str | None = None) -> None:
    """Serve a :class:`Page` and step until Ctrl-C."""
    page = Page(session, title, host, port, no_renderer)
    if page.server.get_port() != port:
        print(f"Port {port} is taken.")
    if page.guard.token:
        print("Warning: other machines reach this page, unencrypted; whoever has its address can steer the robots.")
    print(f"See it walk: {page.url} (Ctrl-C ends)", flush=True)
    try:
        with StopRequest(lambda text: session.stop()):
            session.run()
    finally:
        page.close()
