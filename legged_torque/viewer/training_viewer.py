"""The page and the videos of a running training, made from its checkpoints by low-priority processes on the CPU."""

import contextlib
import errno
import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from legged_torque import SCRIPTS_DIR
from legged_torque.utils.display import warn
from legged_torque.utils.distributed import ending_with_parent
from legged_torque.utils.errors import UserError, require
from legged_torque.utils.runs import checkpoint_number

EXTRAS = {"viewer": ("viser", "trimesh"), "video": ("imageio", "imageio_ffmpeg", "PIL")}
HOST, PORT = "127.0.0.1", 8080  # of the page, or the next free port
VIDEO_STEPS = 250  # control steps of a video: 5 s of most tasks
VIDEO_TIMEOUT = 300.0  # seconds that the end of a training waits for its last video
END_TIMEOUT = 5.0  # seconds after which a process that should end is killed
LOWEST_PRIORITY = 19
OWN_VARIABLES = ("MUJOCO_GL", "RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")  # of the training itself


class TrainingViewer:
    """Starts the page and the videos of a run when it saves checkpoints.

    Attributes:
        page: Address of the page for a browser on this machine; empty without one.
    """

    def __init__(self, has_page: bool, video_interval: int) -> None:
        """Prepare; ``video_interval`` is in iterations, 0 for no videos. A UserError if an extra is missing."""
        for extra, is_wanted in (("viewer", has_page), ("video", video_interval > 0)):
            if is_wanted:
                require(*EXTRAS[extra], extra=extra)
        self._port = free_port(HOST, PORT) if has_page else 0
        self._held = socket.socket()  # until the page starts, so that no other training finds the port free
        if has_page:
            with contextlib.suppress(OSError):  # connections of an earlier page end there
                self._held.bind((HOST, self._port))
        self.page = f"http://{HOST}:{self._port}" if has_page else ""
        self._video_interval, self._next_video = video_interval, 0
        self._page: subprocess.Popen[bytes] | None = None
        self._video: subprocess.Popen[bytes] | None = None
        self._video_log = Path()

    def show(self, task_words: Sequence[str], checkpoint: Path) -> None:
        """Serve the page from the first checkpoint on, and start the video that is due, one at a time.

        ``task_words`` are the options with which scripts find the task.
        """
        words, number = [*task_words, f"--load_run={checkpoint.parent}"], checkpoint_number(checkpoint)
        page_log, video_log = checkpoint.parent / "page.log", checkpoint.parent / "videos" / f"{checkpoint.stem}.log"
        try:
            if self.page and not self._page:
                self._held.close()
                self._page = start([*words, "--viewer=web", f"--port={self._port}"], page_log)
            if self.page and self._page and self._page.poll() is not None:
                self.page = ""
                warn(f"the page has ended; see {page_log}")
            is_busy = self._video and self._video.poll() is None
            if self._video_interval and number >= self._next_video and not is_busy:
                self._check_video()
                self._video = start([*words, f"--checkpoint={number}", f"--steps={VIDEO_STEPS}"], video_log)
                self._video_log, self._next_video = video_log, number + self._video_interval
        except OSError as error:  # the training goes on
            warn(f"nothing is shown of {checkpoint.stem}: {error}")

    def close(self, is_waiting: bool) -> None:
        """End the page and, unless it is waited for, the video."""
        self._held.close()
        if self._page:
            end(self._page)
        if not self._video:
            return
        try:
            if is_waiting and self._video.poll() is None:
                print(f"Waiting for the video of {self._video_log.stem}.", flush=True)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._video.wait(VIDEO_TIMEOUT)
            if is_waiting:
                self._check_video()
        finally:  # Ctrl-C gives it up
            end(self._video)

    def _check_video(self) -> None:
        """Warn if the last video that was started does not exist."""
        if self._video and not self._video_log.with_suffix(".mp4").is_file():
            warn(f"there is no video of {self._video_log.stem}; see {self._video_log}")


def start(words: list[str], log: Path) -> subprocess.Popen[bytes]:
    """Start ``play.py`` on the CPU with the lowest priority, with its output in a file."""
    log.parent.mkdir(exist_ok=True)
    variables = {name: value for name, value in os.environ.items() if name not in OWN_VARIABLES}
    nice = ["nice", "-n", str(LOWEST_PRIORITY)] if hasattr(os, "nice") else []
    command = [*nice, sys.executable, str(SCRIPTS_DIR / "play.py"), *words, "--device=cpu"]
    with log.open("wb") as file:
        return subprocess.Popen(
            ending_with_parent(command),
            env=variables | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for the training
        )


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process and wait for it."""
    process.terminate()
    try:
        process.wait(END_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def free_port(host: str, port: int) -> int:
    """Return the first free port from a port on; a UserError for an address that is not this machine's."""
    for candidate in range(port, 65536):
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            with socket.create_server((host, candidate), family=family):
                return candidate
        except OSError as error:
            if error.errno != errno.EADDRINUSE:  # viser would try all ports forever
                raise UserError(f"cannot serve at {host}:{candidate}: {error.strerror or error}") from None
    raise UserError(f"no port from {port} on is free")
