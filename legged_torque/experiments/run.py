"""Runs a matrix of trainings on the workers of a launcher. Finished steps are skipped, interrupted ones resumed."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections import Counter
from datetime import datetime
from pathlib import Path
from statistics import fmean
from types import FrameType
from typing import BinaryIO

from legged_torque.experiments.experiment_display import ExperimentDisplay
from legged_torque.experiments.job import LOST, Job, Launcher, Worker, try_lock
from legged_torque.experiments.matrix import SETTINGS_FILE, Cell, Matrix, check_same
from legged_torque.experiments.times import add_up, describe, read_times
from legged_torque.utils.display import duration, time_left_text
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import held
from legged_torque.utils.interrupt import StopRequest

POLL = 0.2  # seconds between checks of the processes
RETRIES = 1  # of a step that has failed, from its last checkpoint, before its cell is given up
MAX_LOST = 10  # machines that a step may lose before its cell is given up


class CountedStop(StopRequest):
    """While this context is open, Ctrl-C and SIGTERM are only counted, so that they can be passed on."""

    count = 0

    def _handle(self, number: int, frame: FrameType | None) -> None:
        """Count a signal."""
        self.requested = True
        self.count += 1


class ExperimentRun:
    """Trains and evaluates all cells of a matrix."""

    def __init__(self, matrix: Matrix, out: Path, launcher: Launcher) -> None:
        """Find the cells that are not done; nothing is written or started yet. ``out`` is an absolute path."""
        self.matrix, self.out, self._launcher = matrix, out, launcher
        cells = matrix.cells(out)
        self.queue = [cell for cell in cells if cell.missing()]
        self._num_cells, self._num_done = len(cells), len(cells) - len(self.queue)
        self._failures: list[str] = []  # a message per failed cell
        self._reported: set[Cell] = set()  # cells reported to be held by another process
        self._failed: Counter[Cell] = Counter()  # how often a cell's present step has failed
        self._lost: Counter[Cell] = Counter()  # how often its machine was lost
        self._durations: list[float] = []  # of cells finished here [s]
        self._start = self._counted = time.monotonic()

    def run(self) -> int:
        """Work until all cells are done or have failed; return the exit status. Asked to stop: KeyboardInterrupt."""
        print(f"{self._num_done} of {self._num_cells} cells are done in {self.out}", flush=True)
        passed_on, stop = 0, CountedStop()
        try:
            with stop, ExperimentDisplay(self.out.name) as display:
                while self._jobs() or (self.queue and not stop.requested):
                    if stop.count > passed_on:
                        passed_on = stop.count
                        self._ask_to_stop()
                    self._count_time()
                    for worker in list(self._launcher.workers()):
                        self._attend(worker, stop.requested)
                    self._show(display)
                    time.sleep(POLL)
        finally:
            self._ask_to_stop()  # after an exception too no process is left running
            for job in self._jobs():
                with contextlib.suppress(UserError):  # what one has to tell must not keep others from coming home
                    job.process.wait()
        spent = describe(add_up(read_times(cell.folder) for cell in self.matrix.cells(self.out)))
        if spent:
            print(spent)
        print(f"{self._num_done} of {self._num_cells} cells are done.", flush=True)
        for failure in self._failures:
            print(failure, file=sys.stderr)
        if stop.requested:
            raise KeyboardInterrupt
        return 1 if self._failures else 0

    def _jobs(self) -> list[Job]:
        """Return the jobs that are running."""
        return [worker.job for worker in self._launcher.workers() if worker.job is not None]

    def _attend(self, worker: Worker, stopping: bool) -> None:
        """Finish a worker's step if its process has ended, and give it the next step if it is free."""
        job = worker.job
        if job is not None and job.process.poll() is not None:
            worker.job = None
            self._end_step(worker, job, stopping)
        if worker.job is None and not stopping:
            self._take_cell(worker)

    def _take_cell(self, worker: Worker) -> None:
        """Start the first cell that no other process holds, if there is one."""
        for cell in list(self.queue):
            lock = try_lock(cell.folder / "lock")
            if lock is None:
                if cell not in self._reported:
                    self._reported.add(cell)
                    self._print(f"{cell.name}: another process works on it; left for later")
                continue
            self.queue.remove(cell)
            if cell.missing():
                self._start_step(worker, cell, lock, time.monotonic())
                return
            self._num_done += 1  # finished by another process
            lock.close()

    def _start_step(self, worker: Worker, cell: Cell, lock: BinaryIO, cell_start: float) -> None:
        """Start the next step of a cell."""
        try:
            worker.job = Job(self.matrix, cell, lock, cell_start, worker, self._launcher)
        except (OSError, subprocess.SubprocessError, UserError) as error:
            self._fail(cell, lock, str(error))

    def _end_step(self, worker: Worker, job: Job, stopping: bool) -> None:
        """Record the outcome of a step that has ended, and continue with its cell."""
        problem = job.problem()
        self._keep_times(job)
        if problem and not stopping:
            self._try_again_or_fail(job, problem)
            return
        is_done = not job.cell.missing()
        if is_done:
            self._num_done += 1
            self._durations.append(time.monotonic() - job.cell_start)
        if not problem:
            self._failed[job.cell] = self._lost[job.cell] = 0
            took = duration(time.monotonic() - job.start)
            self._print(f"{job.cell.name}: {job.step_text()} on {worker.name} took {took} | {self._progress()}")
        if is_done or stopping:
            job.lock.close()
            self.queue += [] if is_done else [job.cell]
        else:
            self._start_step(worker, job.cell, job.lock, job.cell_start)

    def _try_again_or_fail(self, job: Job, problem: str) -> None:
        """Let a step that has failed be tried again, from its last checkpoint, or give up its cell."""
        is_lost = job.process.returncode == LOST
        tries, most = (self._lost, MAX_LOST) if is_lost else (self._failed, RETRIES)
        tries[job.cell] += 1
        if tries[job.cell] > most:
            self._fail(job.cell, job.lock, problem, job)
            return
        job.lock.close()
        self.queue.insert(0 if is_lost else len(self.queue), job.cell)
        self._print(f"{job.cell.name}: {problem}; it will be tried again | {self._progress()}")

    def _fail(self, cell: Cell, lock: BinaryIO, reason: str, job: Job | None = None) -> None:
        """Give up a cell; the last ten lines of the job's log are printed at the end."""
        lock.close()
        lines = [f"the last lines of {job.log}:", *job.output().splitlines()[-10:]] if job else []
        self._failures.append("\n    ".join([f"{cell.name}: {reason}", *lines]))
        self._print(f"{cell.name}: {reason} | {self._progress()}")

    def _count_time(self) -> None:
        """Count the time since the last call for all steps, those of one device sharing it."""
        now = time.monotonic()
        passed, self._counted = now - self._counted, now
        busy = [worker for worker in self._launcher.workers() if worker.job is not None and worker.name]
        sharing = Counter(worker.name for worker in busy)
        for worker in busy:
            assert worker.job is not None
            worker.job.add_time(passed / sharing[worker.name])
            if worker.job.times_are_due():
                self._keep_times(worker.job)

    def _keep_times(self, job: Job) -> None:
        """Write the device time of a cell; that it cannot be written is told, and work goes on."""
        try:
            job.keep_times()
        except (OSError, UserError) as error:
            self._print(f"{job.cell.name}: its device time is not kept: {error}")

    def _ask_to_stop(self) -> None:
        """Ask all processes to end. A training finishes its iteration and saves; a second request ends it at once."""
        for job in self._jobs():
            job.process.terminate()
        if self._jobs():
            self._print("Stopping: trainings finish their iteration and save; once more to stop at once.")

    def _progress(self) -> str:
        """Describe the progress of all cells and the time left; cells in training count in part."""
        elapsed, left = duration(time.monotonic() - self._start), time_left_text(self._time_left())
        return f"{self._num_done} of {self._num_cells} cells done, {elapsed}, {left}"

    def _time_left(self) -> float | None:
        """Return the time for all cells that are left [s]; None if unknown."""
        cells = self._num_cells - self._num_done - len(self._failures) - sum(job.fraction() for job in self._jobs())
        return time_left(self._durations, cells, len(self._launcher.workers()))

    def _print(self, text: str) -> None:
        """Print a line with the time."""
        print(f"{datetime.now():%Y-%m-%d %H:%M:%S}  {text}", flush=True)

    def _show(self, display: ExperimentDisplay) -> None:
        """Update the display, if it is shown and the update is due."""
        if display.is_due():
            rows = [worker.job.row(worker.name) for worker in self._launcher.workers() if worker.job is not None]
            share = (self._num_done + sum(job.fraction() for job in self._jobs())) / self._num_cells
            display.set_state(f"{self._num_done} of {self._num_cells} cells done", share, self._time_left(), rows)


def claim_folder(matrix: Matrix, file: Path, out: Path) -> None:
    """Create the folder of the results, and copy the matrix's file into it; UserError if it has other settings."""
    check_same(matrix, out)  # before anything is created
    out.mkdir(parents=True, exist_ok=True)
    with held(out / "lock"):  # another process may do the same right now
        check_same(matrix, out)
        copy, text = out / SETTINGS_FILE, file.read_bytes()
        if not copy.is_file() or copy.read_bytes() != text:
            part = copy.with_suffix(".yaml.part")
            part.write_bytes(text)
            os.replace(part, copy)


def time_left(durations: list[float], cells: float, num_workers: int) -> float | None:
    """Return the time for the cells that are left [s], from the durations of finished ones [s]; None if unknown."""
    if cells <= 0:
        return 0.0
    return fmean(durations) * max(cells / num_workers, min(cells, 1.0)) if durations else None
