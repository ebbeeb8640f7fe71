"""Videos of the followed robot that are recorded from the page and downloaded to the browser."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import viser

from legged_torque import resource_path
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.utils.errors import UserError
from legged_torque.viewer.framing import TRUNK
from legged_torque.viewer.ground import drawn_model, ground_of
from legged_torque.viewer.reading import Reading
from legged_torque.viewer.video import Moment, write_video

LONGEST = 60.0  # seconds of a video


class Recording:
    """Collects steps between two clicks, and draws them as :mod:`~legged_torque.viewer.video` does."""

    def __init__(self, server: viser.ViserServer, task: LeggedRobot, no_renderer: str | None) -> None:
        """Add the button; ``no_renderer`` is a reason why nothing can be drawn."""
        self._server, self._no_renderer, self._control_step = server, no_renderer, task.dt
        self._robot, self._joints, self._ground = resource_path(task.cfg.asset.file), task.dof_names, ground_of(task)
        self._moments: list[Moment] = []
        self._last, self._is_on = 0.0, False
        self._button = server.gui.add_button(
            "Record", icon="video", hint=f"up to {LONGEST:.0f} s of the followed robot"
        )
        self._button.on_click(lambda event: self._click())

    def update(self, past: Sequence[Reading]) -> None:
        """Collect the steps that are new in ``past``, the last ones of the session."""
        if self._is_on:
            for reading in (reading for reading in past if reading.time > self._last):
                rows = (reading.qpos, reading.commands, reading.velocities)
                self._moments.append(Moment(*(row[reading.world] for row in rows)))
            if len(self._moments) * self._control_step > LONGEST:
                self._click()
        self._last = past[-1].time

    def _click(self) -> None:
        """Start, or end and draw in a thread of its own."""
        self._is_on = not self._is_on
        self._button.label = "Stop and download" if self._is_on else "Record"
        if not self._is_on:
            moments, self._moments = self._moments, []
            threading.Thread(target=self._send, args=(moments,), name="recording", daemon=True).start()

    def _send(self, moments: list[Moment]) -> None:
        """Draw a video and send it to the browsers, or tell why there is none."""
        self._notify("Drawing the video", f"{len(moments) * self._control_step:.1f} s", "blue")
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "walking.mp4"
            try:
                if self._no_renderer or not moments:
                    raise UserError(self._no_renderer or "nothing has moved")
                model = drawn_model(self._robot, self._ground, self._joints)
                write_video(file, model, TRUNK, [[moment] for moment in moments], self._control_step, self._ground)
                self._server.send_file_download(file.name, file.read_bytes(), save_immediately=True)
            except UserError as error:
                self._notify("There is no video", str(error), "red")

    def _notify(self, title: str, text: str, color: str) -> None:
        """Show a line in all browsers."""
        for client in self._server.get_clients().values():
            client.add_notification(title, text, color=color, auto_close_seconds=10)
