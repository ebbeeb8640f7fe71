"""Videos of the followed robot that are recorded on the page and downloaded by the browser."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path

import viser

from legged_torque.utils.errors import UserError
from legged_torque.viewer.session import Session
from legged_torque.viewer.video import Moment, TaskRecorder, VideoRecorder

MAX_SECONDS = 60.0  # of a video
NOTICE_SECONDS = 10.0  # for which notifications are shown
START, STOP = "Record", "Stop and download"  # labels of the button


class Recording:
    """A button that starts and ends a recording, which is then drawn."""

    def __init__(self, server: viser.ViserServer, session: Session, no_renderer: str | None) -> None:
        """Add the button; ``no_renderer`` is a reason why nothing can be drawn."""
        self._server, self._session, self._no_renderer = server, session, no_renderer
        self._recorder: VideoRecorder | None = None
        self._last = 0.0  # time of the last step that has been recorded [s]
        hint = f"up to {MAX_SECONDS:.0f} s of the followed robot"
        self._button = server.gui.add_button(START, icon=viser.Icon.VIDEO, hint=hint)
        self._button.on_click(lambda event: self._click())

    def update(self) -> None:
        """Record the new steps of the session."""
        recorder = self._recorder
        if recorder:
            for one in (one for one in list(self._session.history) if one.time > self._last):
                moment = Moment(one.qpos[one.world], one.commands[one.world], one.velocities[one.world])
                recorder.steps.append([moment])
                self._last = one.time
            if len(recorder.steps) * self._session.task.dt > MAX_SECONDS:
                self._click()

    def _click(self) -> None:
        """Start, or end and draw in a thread of its own."""
        if self._recorder:
            recorder, self._recorder = self._recorder, None
            threading.Thread(target=self._send, args=(recorder,), name="recording", daemon=True).start()
        else:
            self._recorder, self._last = TaskRecorder(self._session.task), self._session.sim_time
            self._button.label = STOP

    def _send(self, recorder: VideoRecorder) -> None:
        """Draw a video and send it to the browsers, or show why there is none."""
        self._button.disabled = True
        try:
            if self._no_renderer or not recorder.steps:
                raise UserError(self._no_renderer or "nothing has moved")
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "walking.mp4"
                recorder.write(file, self._show_progress)
                self._server.send_file_download(file.name, file.read_bytes(), save_immediately=True)
        except Exception as error:  # the page goes on
            reason = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
            notify(self._server, "There is no video", reason)
        finally:
            self._button.label, self._button.disabled = START, False

    def _show_progress(self, frame: int, total: int) -> None:
        """Show in the button how many frames have been drawn."""
        self._button.label = f"Drawing frame {frame} of {total}"


def notify(server: viser.ViserServer, title: str, text: str) -> None:
    """Show an error in all browsers."""
    for client in server.get_clients().values():
        client.add_notification(title, text, color="red", auto_close_seconds=NOTICE_SECONDS)
