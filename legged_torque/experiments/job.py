"""Processes of an experiment: a step of a cell runs in its own process, on a worker."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

from legged_torque.experiments.matrix import Cell, CellState
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.errors import UserError

MAX_JOBS = 1000
_TAIL = 65536  # bytes that are read from the end of a log
_ITERATION = re.compile(r"Learning iteration (\d+)/(\d+)")
_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1  # Linux


@dataclass
class Worker:
    """A device that runs one process at a time."""

    name: str  # the user's: "cpu", "cuda:1"
    device: str  # the --device of its processes
    variables: dict[str, str]  # additional environment variables of its processes
    job: Job | None = None


class Job:
    """A step of a cell in its own process, which writes to ``log``."""

    def __init__(
        self, cell: Cell, state: CellState, lock: BinaryIO, cell_start: float, command: list[str], worker: Worker
    ) -> None:
        """Start the process, which gets SIGTERM if this process ends.

        ``lock`` is the cell's open lock file: the process holds it too, and its id is written to it. ``cell_start`` is
        when the work on the cell began, by ``time.monotonic()`` [s].
        """
        self.cell, self.state, self.lock, self.cell_start = cell, state, lock, cell_start
        self.log = cell.folder / ("evaluate.log" if state.step == "evaluate" else "train.log")
        with open(self.log, "ab") as file:
            file.write(f"{datetime.now():%Y-%m-%d %H:%M:%S} {shlex.join(command)}\n".encode())
            file.flush()
            self._log_start = file.tell()  # size of the file when the step began [bytes]
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=os.environ | {"PYTHONUNBUFFERED": "1"} | worker.variables,
                pass_fds=[lock.fileno()],
                start_new_session=True,  # Ctrl-C reaches only this process, which passes it on
                preexec_fn=end_with_parent if sys.platform == "linux" else None,
            )
        self.start = time.monotonic()
        with contextlib.suppress(OSError):  # the id is only for people to read
            lock.truncate(0)
            lock.write(f"{self.process.pid}\n".encode())
            lock.flush()

    def output(self) -> str:
        """Return the end of the log that the process has written so far."""
        with open(self.log, "rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(self._log_start, size - _TAIL))
            return file.read().decode(errors="replace")

    def fraction(self) -> float:
        """Return the fraction of the training's iterations that is done; 1 for an evaluation."""
        if self.state.step == "evaluate":
            return 1.0
        found = _ITERATION.findall(self.output())
        if found:
            return (int(found[-1][0]) + 1) / max(int(found[-1][1]), 1)
        return self.state.iterations / (self.state.total or 1)

    def step_text(self) -> str:
        """Describe the step."""
        if self.state.step == "evaluate":
            return f"evaluation in {self.state.missing[0]}"
        return "training" if self.state.step == "train" else f"training from iteration {self.state.iterations} on"

    def __str__(self) -> str:
        """Describe the step in a few words, with its progress."""
        return f"{self.cell.name} {'evaluation' if self.state.step == 'evaluate' else f'{self.fraction():.0%}'}"


def end_with_parent() -> None:
    """Ask the system to send SIGTERM to this process when its parent ends for any reason."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def try_lock(file: Path) -> BinaryIO | None:
    """Lock a new or old file until it is closed here and in all processes that inherit it; None if another holds it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    lock = file.open("ab")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    return lock


def find_workers(device: str, jobs: int | None) -> list[Worker]:
    """Return the workers: one per GPU ("auto": all GPUs if any), or ``jobs`` on the CPU; UserError if not possible."""
    import torch

    first = resolve_device(device)  # does not create a CUDA context
    if jobs is not None and jobs < 1:
        raise UserError(f"--jobs must be at least 1, not {jobs}")
    if jobs is not None and jobs > MAX_JOBS:
        raise UserError(f"--jobs must be at most {MAX_JOBS}, not {jobs}")
    if first == "cpu":
        jobs, variables = jobs or 1, {}
        if jobs > 1 and "OMP_NUM_THREADS" not in os.environ:  # they share the cores
            variables["OMP_NUM_THREADS"] = str(max(1, (os.cpu_count() or 1) // jobs))
        return [Worker("cpu", "cpu", variables) for _ in range(jobs)]
    if jobs is not None:
        raise UserError("--jobs is for the CPU; a GPU takes one run at a time")
    numbers = range(torch.cuda.device_count()) if device == "auto" else [int(first.removeprefix("cuda:"))]
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(i) for i in range(torch.cuda.device_count())]
    return [Worker(f"cuda:{i}", "cuda:0", {"CUDA_VISIBLE_DEVICES": names[i].strip()}) for i in numbers]
