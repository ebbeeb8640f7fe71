"""One step of a cell of an experiment in a process of its own, and where such processes run."""

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

import torch

from legged_torque.experiments.matrix import Cell, State
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.errors import UserError

LAST_LINES = 10
"""Lines of a failed step's log that are shown."""
_TAIL = 65536  # bytes at the end of a log that are read
_ITERATION = re.compile(rb"Learning iteration (\d+)/(\d+)")
_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1  # Linux


@dataclass
class Worker:
    """A place where one process runs at a time.

    Attributes:
        name: What the user calls it, "cpu" or "cuda:1".
        device: What its processes are given as ``--device``.
        variables: Environment variables of its processes, beyond those of this one.
        job: What it does at the moment.
    """

    name: str
    device: str
    variables: dict[str, str]
    job: Job | None = None


@dataclass
class Job:
    """A step of a cell, in a process of its own.

    Attributes:
        cell: The cell.
        state: How far it was when the step began.
        lock: The cell's open lock file; the process holds it too.
        cell_start: When the work on the cell began, of ``time.monotonic()`` [s].
        start: When the step began [s].
        log: File that the process writes to.
        log_start: Size of the file when the step began [bytes].
        process: The process.
    """

    cell: Cell
    state: State
    lock: BinaryIO
    cell_start: float
    start: float
    log: Path
    log_start: int
    process: subprocess.Popen

    def output(self) -> bytes:
        """Return the end of what the process has written so far."""
        with open(self.log, "rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(self.log_start, size - _TAIL))
            return file.read()

    def fraction(self) -> float:
        """Return which part of the training's iterations is done, from 0 to 1; evaluations count as done."""
        if self.state.step == "evaluate":
            return 1.0
        found = _ITERATION.findall(self.output())
        if found:
            return (int(found[-1][0]) + 1) / max(int(found[-1][1]), 1)
        return self.state.iterations / (self.state.total or 1)

    def last_lines(self) -> list[str]:
        """Return the last lines of what the process has written."""
        return self.output().decode(errors="replace").splitlines()[-LAST_LINES:]

    def step_text(self) -> str:
        """Say what the step is."""
        if self.state.step == "evaluate":
            return f"evaluation in {self.state.missing[0]}"
        return "training" if self.state.step == "train" else f"training from iteration {self.state.iterations} on"

    def __str__(self) -> str:
        """Say in a few words what goes on."""
        if self.state.step == "evaluate":
            return f"{self.cell.name} evaluation"
        return f"{self.cell.name} {100 * self.fraction():.0f}%"


def start_job(
    out: Path,
    cell: Cell,
    state: State,
    command: list[str],
    variables: dict[str, str],
    lock: BinaryIO,
    cell_start: float,
) -> Job:
    """Start a process for a step of a cell. It holds the cell's lock too, and is asked to end if this process ends.

    Args:
        out: Folder of all results.
        cell: The cell.
        state: How far it is.
        command: Command line of the process.
        variables: Environment variables of the process, beyond those of this one.
        lock: The cell's lock file, which gets the number of the process.
        cell_start: When the work on the cell began [s].
    """
    log = out / cell.name / ("evaluate.log" if state.step == "evaluate" else "train.log")
    with open(log, "ab") as file:
        file.write(f"{datetime.now():%Y-%m-%d %H:%M:%S} {shlex.join(command)}\n".encode())
        file.flush()
        log_start = file.tell()
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1"} | variables,
            pass_fds=[lock.fileno()],
            start_new_session=True,  # Ctrl-C reaches this process alone, which passes it on
            preexec_fn=end_with_parent if sys.platform == "linux" else None,
        )
    with contextlib.suppress(OSError):  # the number is only there for people to read
        lock.truncate(0)
        lock.write(f"{process.pid}\n".encode())
        lock.flush()
    return Job(cell, state, lock, cell_start, time.monotonic(), log, log_start, process)


def end_with_parent() -> None:
    """Let the system send SIGTERM to this process when its parent ends, however it ends."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def try_lock(file: Path) -> BinaryIO | None:
    """Return a lock file, created and locked until it is closed here and in all processes that it was passed to.

    None if another process holds it.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    lock = open(file, "ab")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    return lock


def find_workers(device: str, jobs: int | None) -> list[Worker]:
    """Return where processes run: on every GPU one, or on the CPU as many as wanted.

    Args:
        device: "auto" (all GPUs if there are any), "cpu", "cuda" or "cuda:N".
        jobs: Processes at a time on the CPU; None is 1.

    Raises:
        UserError: If there is no such device, or the number of processes makes no sense.
    """
    first = resolve_device(device)  # of which torch needs no CUDA context
    if jobs is not None and jobs < 1:
        raise UserError(f"--jobs must be at least 1, not {jobs}")
    if first == "cpu":
        jobs = jobs or 1
        variables = {}
        if jobs > 1 and "OMP_NUM_THREADS" not in os.environ:  # they share the cores
            variables["OMP_NUM_THREADS"] = str(max(1, (os.cpu_count() or 1) // jobs))
        return [Worker("cpu", "cpu", variables) for _ in range(jobs)]
    if jobs is not None:
        raise UserError("--jobs is for the CPU; a GPU takes one run at a time")
    numbers = range(torch.cuda.device_count()) if device == "auto" else [int(first.removeprefix("cuda:"))]
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(i) for i in range(torch.cuda.device_count())]
    return [Worker(f"cuda:{i}", "cuda:0", {"CUDA_VISIBLE_DEVICES": names[i].strip()}) for i in numbers]
