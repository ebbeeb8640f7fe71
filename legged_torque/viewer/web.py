"""A page that shows and steers a session: ``play.py --viewer web``."""

from __future__ import annotations

import html
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import viser

from legged_torque.viewer.access import Guard
from legged_torque.viewer.controls import Controls
from legged_torque.viewer.ground import Ground, drawn_model, ground_of
from legged_torque.viewer.layers import commanded_pose
from legged_torque.viewer.pacing import stopping_on_ctrl_c
from legged_torque.viewer.plots import WIDTH, Plots
from legged_torque.viewer.ports import free_port
from legged_torque.viewer.recording import Recording
from legged_torque.viewer.scene import Scene
from legged_torque.viewer.session import Session
from legged_torque.viewer.state import SessionState
from legged_torque.viewer.steering import Steering

FRAME_INTERVAL = 1.0 / 30.0  # seconds between drawings of the robots
PLOT_INTERVAL = 0.2  # seconds between drawings of the plots and the status


class PrivateServer(viser.ViserServer):
    """A server that opens no way in from the internet, which viser does for any page that asks."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse."""
        return None


class Page:
    """Draws a session in a thread of its own, which never touches the task's tensors."""

    def __init__(
        self, session: Session, robot: Path, title: str, host: str, port: int, no_renderer: str | None = None
    ) -> None:
        """Serve the page at a port or the next free one.

        Args:
            session: What is shown.
            robot: Its MJCF, visual geoms included.
            title: Of the page.
            host: Address that is served at.
            port: The first one to try.
            no_renderer: Why no videos can be drawn here; None if they can.
        """
        self._session, self.guard = session, Guard(host)
        self._steering = Steering()
        with self.guard.at_the_door(self._steering.around):
            self.server = PrivateServer(host, free_port(host, port), label=title, verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(47, 125, 246))
        self._ground = ground_of(session.task)
        model, geoms = drawn_model(robot, None, session.task.dof_names), session.task.asset.geom_names
        self._scene = Scene(self.server, model, session.task.num_envs, geoms, self._ground)
        if session.companion:
            self._scene.name_robots(session.name, session.companion.name)
        self.controls = Controls(self.server, session, self._scene)
        self._plots = Plots(self.server, session)
        self._recording = Recording(self.server, session.task, no_renderer)
        self.server.gui.main_panel.dock_right()
        self.server.gui.main_panel.set_width(WIDTH)
        self._message_shown = 0
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
        """Draw until closed; plots and status less often than the robots."""
        next_plots = 0.0
        while not self._closed.wait(FRAME_INTERVAL):
            state, shares = self._session.state, self._steering.take()
            if shares:
                self.controls.steer(shares)
            if state.reading is not None:
                past = list(self._session.history) or [state.reading]
                self._recording.update(past)
                ghost = commanded_pose(past, self._session.task.dt)
                self._scene.update(state.reading, state.world, ghost, self._beside())
            if time.perf_counter() >= next_plots:
                next_plots = time.perf_counter() + PLOT_INTERVAL
                with self.server.atomic():
                    self._plots.update(state)
                    companion = self._session.companion
                    beside = [(companion.name, companion.state)] if companion else []
                    self.controls.status.content = status_html(state, self._ground, beside)
                    self.controls.update(state)
                    self._notify(state)

    def _beside(self) -> np.ndarray | None:
        """Return the positions of the companion's robot, as a row of ``sim.qpos``; None without one."""
        companion = self._session.companion
        reading = companion.state.reading if companion else None
        return reading.qpos[0] if reading else None

    def _notify(self, state: SessionState) -> None:
        """Show an error as a notification on the page."""
        if state.is_error and state.message_number != self._message_shown:
            for client in self.server.get_clients().values():
                client.add_notification("That did not work", state.message, color="red", auto_close_seconds=10)
        self._message_shown = state.message_number


def status_html(
    state: SessionState, ground: Ground | None = None, beside: Sequence[tuple[str, SessionState]] = ()
) -> str:
    """Return the status line by line: checkpoint, time, tile of the followed robot on rough ground, last message.

    ``beside`` are names and states of companions, with a line each.
    """
    running = "paused" if state.is_paused else f"{state.real_time:.2f} x real time"
    color = "#e03131" if state.is_error else "inherit"
    lines = [
        f"<b>model_{state.checkpoint}</b>, after {state.trained_steps / 1e6:,.1f} million steps",
        f"{state.time:.1f} s simulated, {running}, {state.falls} falls",
        *(
            f"beside: <b>{html.escape(name)}</b>, model_{other.checkpoint}, {other.falls} falls"
            for name, other in beside
        ),
        *([ground.tile_text(*state.reading.tile.astype(int))] if ground and state.reading else []),
        f'<span style="color:{color}">{html.escape(state.message) or "&nbsp;"}</span>',
    ]
    return f'<div style="font-size:13px;line-height:1.5;padding:4px 12px">{"<br>".join(lines)}</div>'


def watch(session: Session, robot: Path, title: str, host: str, port: int, no_renderer: str | None = None) -> None:
    """Serve a :class:`Page` and step until Ctrl-C."""
    page = Page(session, robot, title, host, port, no_renderer)
    if page.server.get_port() != port:
        print(f"Port {port} is taken.")
    if page.guard.token:
        print("Warning: other machines reach this page, unencrypted; whoever has its address can steer the robots.")
    print(f"See it walk: {page.url} (Ctrl-C ends)", flush=True)
    try:
        with stopping_on_ctrl_c(session.stop):
            session.run()
    finally:
        page.close()
