"""Steps of an experiment's cells: what runs on a worker, wherever a launcher has started it."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shlex
import time
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Protocol

from legged_torque.experiments.experiment_display import Row
from legged_torque.experiments.matrix import Cell, CellState, Matrix, cell_state, command_of, is_json, step_words
from legged_torque.experiments.times import read_times, write_times
from legged_torque.learning.training_display import UNIT, read_tracking
from legged_torque.utils.display import read_progress
from legged_torque.utils.errors import UserError

CPU_JOBS, GPU_JOBS, MPS_JOBS = 1, 2, 4
"""Runs at a time on each CPU, GPU, and GPU with ``--mps``, unless ``--jobs`` says otherwise: more are hardly faster."""
MAX_JOBS = 1000
LOST = 256
"""Exit status of a step whose machine is gone: no process ends with it."""
_KEEP_EVERY = 20.0  # seconds between writes of the device time
_TAIL = 65536  # bytes that are read from the end of a log
_LAST_LINES = 4096  # characters at the end of a log in which its progress is looked for


class Process(Protocol):
    """A step that runs somewhere, with the part of ``subprocess.Popen`` that is needed."""

    @property
    def pid(self) -> int:
        """Id of a process on this machine, for people to read."""

    @property
    def returncode(self) -> int | None:
        """Exit status: None until the end is noticed, negative after a signal, or :data:`LOST`."""

    def poll(self) -> int | None:
        """Look whether the step has ended, and return ``returncode``."""

    def terminate(self) -> None:
        """Ask the step to end: a training finishes its iteration and saves, after a second request it ends at once."""

    def wait(self) -> int:
        """Wait for the end, and return ``returncode``."""


class Launcher(Protocol):
    """Where steps run."""

    def workers(self) -> list[Worker]:
        """Return what there is to give steps to; a worker with a job stays."""

    def start(
        self, matrix: Matrix, cell: Cell, state: CellState, worker: Worker, log: BinaryIO, lock: BinaryIO
    ) -> Process:
        """Start a step, which writes to the open ``log``, and holds the cell's open ``lock`` file if it can."""


@dataclass
class Worker:
    """What runs one step at a time."""

    name: str  # of its device, for the user: "cpu", "cuda:1", "10.0.0.3 cuda:1"; empty while a step waits for a machine
    device: str  # the --device of its processes
    variables: dict[str, str]  # additional environment variables of its processes
    job: Job | None = None


class Job:
    """A step of a cell, which writes to ``log``."""

    def __init__(
        self, matrix: Matrix, cell: Cell, lock: BinaryIO, cell_start: float, worker: Worker, launcher: Launcher
    ) -> None:
        """Start the cell's next step; results that do not belong to its training are removed before.

        ``lock`` is the cell's open lock file, to which the process's id is written. ``cell_start`` is when the work on
        the cell began, by ``time.monotonic()`` [s].
        """
        self.cell, self.lock, self.cell_start, self.state = cell, lock, cell_start, cell_state(cell)
        if self.state.step != "evaluate":  # they would be results of another training
            for result in cell.results:
                result.unlink(missing_ok=True)
        self._times, self._kept = read_times(cell.folder), time.monotonic()
        self._kind = f"{'cpu' if worker.device == 'cpu' else 'gpu'} {self._step_name}"
        self.log = cell.folder / ("evaluate.log" if self.state.step == "evaluate" else "train.log")
        words = step_words(matrix, cell, self.state, worker.device)
        with open(self.log, "ab") as file:
            file.write(f"{datetime.now():%Y-%m-%d %H:%M:%S} {shlex.join(command_of(words))}\n".encode())
            file.flush()
            self._log_start = file.tell()  # size of the file when the step began [bytes]
            self.process = launcher.start(matrix, cell, self.state, worker, file, lock)
        self.start = time.monotonic()
        with contextlib.suppress(OSError):  # the id is only for people to read
            lock.truncate(0)
            lock.write(f"{self.process.pid}\n".encode())
            lock.flush()

    @property
    def _step_name(self) -> str:
        """The kind of step."""
        return "evaluation" if self.state.step == "evaluate" else "training"

    def add_time(self, seconds: float) -> None:
        """Count device time of the step [s]."""
        self._times.seconds[self._kind] = self._times.seconds.get(self._kind, 0.0) + seconds

    def times_are_due(self) -> bool:
        """Return whether it is time to keep the device time, lest a kill lose it."""
        return time.monotonic() - self._kept >= _KEEP_EVERY

    def keep_times(self) -> None:
        """Write the device time and the steps of training so far; a UserError if that is not possible."""
        self._kept = time.monotonic()
        if self.process.returncode is not None:  # to look for checkpoints takes a while
            self._times.steps = cell_state(self.cell).steps
        write_times(self.cell.folder, self._times)

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
        found = read_progress(self.output()[-_LAST_LINES:])
        if found and found[0] == UNIT:
            return found[1] / max(found[2], 1)
        return self.state.iterations / (self.state.total or 1)

    def row(self, device: str) -> Row:
        """Return what is shown of the step, which runs on a device."""
        text = self.output()[-_LAST_LINES:]
        what, done, total, left = read_progress(text) or ("", 0, 1, "")
        doing = self._step_name if what in ("", UNIT) or self.state.step == "evaluate" else what.partition(",")[0]
        share = f" {done / max(total, 1):.0%}" if what else ""
        return Row(self.cell.name, device or "waiting", f"{doing}{share}", read_tracking(text), left)

    def step_text(self) -> str:
        """Describe the step."""
        if self.state.step == "evaluate":
            return f"evaluation in {self.state.missing[0]}"
        return "training" if self.state.step == "train" else f"training from iteration {self.state.iterations} on"

    def problem(self) -> str:
        """Return why an ended step has failed, or an empty text; a complete result gets its final name."""
        try:
            return self._problem()
        except (OSError, UserError) as error:
            return str(error)

    def _problem(self) -> str:
        """As :meth:`problem`, with what may go wrong while it looks."""
        status = self.process.returncode or 0
        if status == LOST:
            return f"the machine was lost during {self.step_text()}"
        if status:
            how = f"was ended by signal {-status}" if status < 0 else f"has failed with exit status {status}"
            return f"{self.step_text()} {how}"
        if self.state.step != "evaluate":
            state = cell_state(self.cell)
            how_far = f"after {state.iterations} of {state.total} iterations" if state.total else "without a checkpoint"
            return f"training has ended {how_far}" if state.step in ("train", "resume") else ""
        name = self.state.missing[0]
        if not is_json(self.cell.part_file(name)):
            return f"{self.step_text()} has left no readable '{self.cell.part_file(name)}'"
        self.cell.part_file(name).replace(self.cell.result_file(name))
        return ""


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
