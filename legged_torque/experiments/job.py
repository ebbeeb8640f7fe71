"""A step of a cell while it runs: a training or an evaluation, in a process that a launcher has started."""

import contextlib
import fcntl
import os
import shlex
import sys
import time
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Protocol

from legged_torque.experiments.matrix import Cell, CellState, Matrix, cell_state, command_of, is_json, step_words
from legged_torque.experiments.times import STEPS, read_times, write_times
from legged_torque.learning.training_display import UNIT, read_tracking
from legged_torque.utils.display import read_progress
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import write_errors

LOST = 256
"""Exit status of a step whose machine is gone. No process ends with it."""
KEEP_EVERY = 20.0  # seconds between writes of the device time
TAIL = 65536  # bytes that are read from the end of a log
LAST_LINES = 4096  # characters at the end of a log in which its progress is looked for


class Process(Protocol):
    """A step that runs somewhere."""

    place: str  # its device, for the user: "cpu", "cuda:1", "10.0.0.3 cuda:1"; empty while it waits for a machine

    def poll(self) -> int | None:
        """Return the exit status: None while the step runs, negative after a signal, or :data:`LOST`."""

    def terminate(self) -> None:
        """Ask the step to end. A training finishes its iteration and saves; a second request ends it at once."""


class Launcher(Protocol):
    """Starts steps, on this machine or on others."""

    device: str  # the --device of steps

    def room(self) -> int:
        """Return how many steps can run at a time."""

    def start(self, matrix: Matrix, cell: Cell, state: CellState, log: BinaryIO, lock: BinaryIO) -> Process:
        """Start a step, which writes to the open ``log``, and holds the cell's open ``lock`` file if it can."""


class Job:
    """The next step of a cell.

    Attributes:
        log: File that the step writes to.
        process: The step.
        start: When it was started, by ``time.monotonic()`` [s].
    """

    def __init__(self, matrix: Matrix, cell: Cell, lock: BinaryIO, launcher: Launcher) -> None:
        """Start the step; ``lock`` is the cell's open lock file. A new training removes results of an old one."""
        self.cell, self.lock, self.state = cell, lock, cell_state(cell)
        self.kind = "evaluation" if self.state.step == "evaluate" else "training"
        self.log = cell.folder / ("evaluate.log" if self.kind == "evaluation" else "train.log")
        if self.kind == "training":
            for name in cell.evaluations:
                cell.result_file(name).unlink(missing_ok=True)
        words = step_words(matrix, cell, self.state, launcher.device)
        with self.log.open("ab") as file:
            file.write(f"{datetime.now():%Y-%m-%d %H:%M:%S} {shlex.join(command_of(words))}\n".encode())
            file.flush()
            self._log_start = file.tell()  # [bytes]
            self.process = launcher.start(matrix, cell, self.state, file, lock)
        self._time_of = f"{'cpu' if launcher.device == 'cpu' else 'gpu'} {self.kind}"
        self._times = read_times(cell.folder)
        self.start = self._kept = time.monotonic()

    def __str__(self) -> str:
        """Describe the step."""
        if self.kind == "evaluation":
            return f"evaluation in {self.state.missing[0]}"
        return "training" if self.state.step == "train" else f"training from iteration {self.state.iterations} on"

    def add_time(self, seconds: float) -> None:
        """Count device time of the step [s], and write it now and then, so that a kill does not lose it."""
        self._times[self._time_of] = self._times.get(self._time_of, 0.0) + seconds
        if time.monotonic() - self._kept >= KEEP_EVERY:
            self.keep_times()

    def keep_times(self) -> None:
        """Write device time and steps of training; work goes on if that is not possible."""
        self._kept = time.monotonic()
        try:
            if self.process.poll() is not None:  # looking for checkpoints takes a while
                self._times[STEPS] = cell_state(self.cell).steps
            write_times(self.cell.folder, self._times)
        except (OSError, UserError) as error:
            print(f"{self.cell.name}: its device time is not kept: {error}", file=sys.stderr)

    def output(self) -> str:
        """Return the end of what the step has written so far; nothing if its log is gone, without which it goes on."""
        with contextlib.suppress(OSError), self.log.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(self._log_start, size - TAIL))
            return file.read().decode(errors="replace")
        return ""

    def progress(self) -> tuple[str, float, str]:
        """Return what the step does, the fraction of it that is done, and its tracking and time left, for the user."""
        text = self.output()[-LAST_LINES:]
        doing, done, total, left = read_progress(text) or (UNIT, self.state.iterations, self.state.total or 1, "")
        tracking = read_tracking(text)
        notes = [f"tracking {tracking}" if tracking else "", f"{left} left" if left else ""]
        is_usual = doing == UNIT or self.kind == "evaluation"
        return self.kind if is_usual else doing.partition(",")[0], done / max(total, 1), ", ".join(filter(None, notes))

    def problem(self) -> str:
        """Return why the step, which has ended, has failed, or an empty text; a complete result gets its final name."""
        status = self.process.poll() or 0
        if status == LOST:
            return f"the machine was lost during {self}"
        if status:
            how = f"was ended by signal {-status}" if status < 0 else f"has failed with exit status {status}"
            return f"{self} {how}"
        try:
            if self.kind == "training":
                state = cell_state(self.cell)
                if state.step == "train":
                    return "training has ended without a checkpoint"
                so_far = f"after {state.iterations} of {state.total} iterations"
                return f"training has ended {so_far}" if state.step == "resume" else ""
            part, result = (file(self.state.missing[0]) for file in (self.cell.part_file, self.cell.result_file))
            if not is_json(part):
                return f"{self} has left no readable '{part}'"
            part.replace(result)
            return ""
        except (OSError, UserError) as error:
            return str(error)


def try_lock(file: Path) -> BinaryIO | None:
    """Lock a new or old file until it is closed here and in all processes that inherit it; None if another holds it.

    A UserError if it cannot be written.
    """
    with write_errors(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        lock = file.open("ab")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            return None
    return lock
