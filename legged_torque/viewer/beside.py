"""Processes beside a training that show it: a page that follows it, and short videos. They see nothing but its files.

They leave the GPU to the training, and give way to it on the processor.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from legged_torque import SCRIPTS_DIR
from legged_torque.utils.display import warn
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import checkpoint_number
from legged_torque.viewer.ports import free_port

EXTRAS = {"viewer": ("viser", "trimesh"), "video": ("imageio", "imageio_ffmpeg", "PIL")}
PORT = 8080  # of the page, or the next free one
VIDEO_STEPS = 250  # control steps of a video: 5 s
LAST_VIDEO_TIMEOUT = 300.0  # seconds that the end of a training waits for its last video
OWN_VARIABLES = ("MUJOCO_GL", "RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")  # of the training itself
END_WITH_PARENT = f"""
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, {int(signal.SIGTERM)}, 0, 0, 0)  # PR_SET_PDEATHSIG of linux/prctl.h
os.execv(sys.argv[1], sys.argv[1:])
"""
"""Runs a command that ends with a parent that is killed; elsewhere than on Linux it would stay."""


class Beside:
    """Starts what shall be seen of a run, at its checkpoints.

    Attributes:
        page: Address of the page for a browser on this machine; empty without one.
    """

    def __init__(self, has_page: bool, video_interval: int) -> None:
        """Prepare; ``video_interval`` is in iterations, 0 for no videos. A UserError if an extra is missing."""
        for extra, is_wanted in (("viewer", has_page), ("video", video_interval > 0)):
            missing = [name for name in EXTRAS[extra] if is_wanted and not find_spec(name)]
            if missing:
                lacking = f"{', '.join(missing)} is missing"
                raise UserError(f"this needs the extra: pip install 'legged_torque[{extra}]' ({lacking})")
        self._port = free_port("127.0.0.1", PORT) if has_page else 0
        self.page = f"http://127.0.0.1:{self._port}" if has_page else ""
        self._video_interval, self._next_video = video_interval, 0
        self._page: subprocess.Popen[bytes] | None = None
        self._page_has_ended = False  # by itself, which has been told
        self._video: subprocess.Popen[bytes] | None = None
        self._video_log = Path()

    def show(self, words_of_task: Sequence[str], checkpoint: Path) -> None:
        """Serve the page from the first checkpoint of a run on, and start the video that is due, one at a time.

        ``words_of_task`` are those with which scripts find its task.
        """
        try:
            self._show([*words_of_task, f"--load_run={checkpoint.parent}"], checkpoint)
        except OSError as error:  # training goes on: what is learned is worth more
            warn(f"nothing is shown of {checkpoint.stem}: {error}")

    def _show(self, words: list[str], checkpoint: Path) -> None:
        """Do so; ``words`` are those with which scripts find the run."""
        number = checkpoint_number(checkpoint)
        if self.page and not self._page:
            self._page = start([*words, "--viewer=web", f"--port={self._port}"], checkpoint.parent / "page.log")
        if self._page and self._page.poll() is not None and not self._page_has_ended:
            self._page_has_ended = True
            warn(f"the page has ended; {checkpoint.parent / 'page.log'} tells why")
        is_busy = self._video is not None and self._video.poll() is None
        if self._video_interval and number >= self._next_video and not is_busy:
            self._check_video()
            words += [f"--checkpoint={number}", f"--steps={VIDEO_STEPS}"]
            self._video_log = checkpoint.parent / "videos" / f"{checkpoint.stem}.log"
            self._video = start(words, self._video_log)
            self._next_video = number + self._video_interval

    def close(self, is_waiting: bool) -> None:
        """End the page, and the video too unless it is waited for."""
        if self._page:
            end(self._page)
        if not self._video:
            return
        try:
            if is_waiting and self._video.poll() is None:
                print(f"Waiting for the video of {self._video_log.stem}.", flush=True)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._video.wait(LAST_VIDEO_TIMEOUT)
            if is_waiting:
                self._check_video()
        finally:  # Ctrl-C gives it up
            end(self._video)

    def _check_video(self) -> None:
        """Tell if there is no video of the checkpoint that was its turn last."""
        if self._video and not self._video_log.with_suffix(".mp4").is_file():
            warn(f"there is no video of {self._video_log.stem}; {self._video_log} tells why")


def start(words: list[str], log: Path) -> subprocess.Popen[bytes]:
    """Start ``play.py`` on the CPU, out of the way of a training; what it prints goes into a file."""
    log.parent.mkdir(exist_ok=True)
    variables = {name: value for name, value in os.environ.items() if name not in OWN_VARIABLES}
    variables |= {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, str(SCRIPTS_DIR / "play.py"), *words, "--device=cpu"]
    command = [sys.executable, "-c", END_WITH_PARENT, *command] if sys.platform == "linux" else command
    with log.open("wb") as file:
        process = subprocess.Popen(
            command,
            env=variables,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for the training
        )
    if hasattr(os, "setpriority"):
        os.setpriority(os.PRIO_PROCESS, process.pid, 19)
    return process


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process, and wait for it."""
    process.terminate()
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
