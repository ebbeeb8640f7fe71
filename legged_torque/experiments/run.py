"""Runs a matrix of trainings on a launcher. Finished steps are skipped, interrupted ones resumed."""

import contextlib
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Column

from legged_torque.experiments.job import LOST, Job, Launcher, try_lock
from legged_torque.experiments.matrix import SETTINGS_FILE, Cell, Matrix, check_same, is_done
from legged_torque.experiments.times import describe, read_times
from legged_torque.utils.display import duration, is_terminal, times
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import held, write_whole
from legged_torque.utils.interrupt import StopRequest

POLL = 0.2  # seconds between checks of the processes
SPEED_OVER = 24 * 3600.0  # seconds over which the speed is averaged
REDRAW_EVERY = 1.0  # seconds between updates of the display
RETRIES = 1  # of a step that has failed, from its last checkpoint, before its cell is given up
MAX_LOST = 10  # machines that a step may lose before its cell is given up


class CountedStop(StopRequest):
    """While this context is open, Ctrl-C and SIGTERM are only counted, so that they can be passed on."""

    count = 0

    def _handle(self, number: int) -> None:
        """Count a signal, but once those of a terminal that closes."""
        self.count += not (self.requested and number == signal.SIGHUP)
        self.requested, self.number = True, self.number or number


class ExperimentRun:
    """Trains and evaluates all cells of a matrix."""

    def __init__(self, matrix: Matrix, out: Path, launcher: Launcher) -> None:
        """Find the cells that are not done; nothing is written or started yet. ``out`` is an absolute path."""
        self._matrix, self._out, self._launcher = matrix, out, launcher
        cells = matrix.cells(out)
        self._queue = [cell for cell in cells if not is_done(cell)]
        self._num_cells, self._num_done = len(cells), len(cells) - len(self._queue)
        self._display = bars()
        self._all = self._display.add_task("", total=self._num_cells, completed=self._num_done, note="")
        self._running: dict[Iterator[Job], Job] = {}  # the steps of each cell in work, and the present one
        self._failures: list[str] = []  # a message per failed cell
        self._reported: set[Cell] = set()  # cells reported to be held by another process
        self._counted = self._shown = time.monotonic()
        self._stop, self._unread = CountedStop(), 0

    def run(self) -> int:
        """Work until all cells are done or have failed; return the exit status, that of a signal to stop."""
        print(f"{self._num_done} of {self._num_cells} cells are done in {self._out}", flush=True)
        passed_on = 0
        try:
            with self._stop, self._display:
                while self._running or (self._queue and not self._stop.requested):
                    if (asked := max(self._stop.count, self._unread)) > passed_on:
                        passed_on = asked
                        self._ask_to_stop()
                    self._count_time()
                    for steps, job in list(self._running.items()):
                        if job.process.poll() is not None:
                            self._advance(steps)
                    self._take_cells()
                    self._show()
                    time.sleep(POLL)
        finally:
            if not passed_on:  # a second request would keep them from saving
                self._ask_to_stop()  # after an exception too no process is left running
            for job in self._running.values():
                with contextlib.suppress(UserError):  # an error of one must not keep others from saving
                    while job.process.poll() is None:
                        time.sleep(POLL)
        spent = describe(read_times(cell.folder) for cell in self._matrix.cells(self._out))
        for failure in self._failures:  # first, as the next line ends it all where nobody reads
            print(failure, file=sys.stderr)
        print(*filter(None, [spent, f"{self._num_done} of {self._num_cells} cells are done."]), sep="\n", flush=True)
        if self._stop.requested:
            print("interrupted", file=sys.stderr)
            return 128 + (self._stop.number or signal.SIGINT)
        return 1 if self._failures else 0

    def _take_cells(self) -> None:
        """Start cells that no other process holds, as long as there is room."""
        for cell in list(self._queue):
            if self._stop.requested or len(self._running) >= self._launcher.room():
                return
            try:
                lock = try_lock(cell.folder / "lock")
            except UserError as error:
                self._queue.remove(cell)
                self._fail(cell, str(error), [])
                continue
            if lock is None:
                if cell not in self._reported:
                    self._reported.add(cell)
                    self._print(f"{cell.name}: another process works on it; left for later")
                continue
            self._queue.remove(cell)
            if is_done(cell):  # by another process
                lock.close()
                self._num_done += 1
            else:
                self._advance(self._steps(cell, lock))

    def _advance(self, steps: Iterator[Job]) -> None:
        """Start the next step of a cell, if there is one."""
        self._running.pop(steps, None)
        for job in steps:
            self._running[steps] = job
            return

    def _steps(self, cell: Cell, lock: BinaryIO) -> Iterator[Job]:
        """Yield each step of a cell, started; the next one must be asked for when it has ended.

        A step that fails is tried again, from its last checkpoint, before the cell is given up.
        """
        tries = Counter[bool]()
        with lock:
            while not is_done(cell):
                try:
                    job = Job(self._matrix, cell, lock, self._launcher)
                except (OSError, subprocess.SubprocessError, UserError) as error:
                    self._fail(cell, str(error), [])
                    return
                yield job
                problem = job.problem()
                job.keep_times()
                if not problem:
                    tries.clear()
                    took = duration(time.monotonic() - job.start)
                    self._num_done += is_done(cell)
                    self._print(f"{cell.name}: {job} on {job.process.place} took {took} | {self._progress()}")
                if self._stop.requested:
                    self._queue += [] if is_done(cell) else [cell]
                    return
                if problem:
                    is_lost = job.process.poll() == LOST
                    tries[is_lost] += 1
                    if tries[is_lost] > (MAX_LOST if is_lost else RETRIES):
                        self._fail(cell, problem, [f"the last lines of {job.log}:", *job.output().splitlines()[-10:]])
                        return
                    self._print(f"{cell.name}: {problem}; it will be tried again | {self._progress()}")

    def _fail(self, cell: Cell, reason: str, lines: list[str]) -> None:
        """Give up a cell; the reason and further lines are printed at the end."""
        self._failures.append("\n    ".join([f"{cell.name}: {reason}", *lines]))
        self._print(f"{cell.name}: {reason} | {self._progress()}")

    def _count_time(self) -> None:
        """Count the time since the last call for all steps; those of one device share it."""
        now = time.monotonic()
        passed, self._counted = now - self._counted, now
        sharing = Counter(job.process.place for job in self._running.values())
        for job in self._running.values():
            if job.process.place:
                job.add_time(passed / sharing[job.process.place])

    def _ask_to_stop(self) -> None:
        """Ask all processes to end. A training finishes its iteration and saves; a second request ends it at once."""
        for job in self._running.values():
            job.process.terminate()
        if self._running:
            self._print("Stopping: trainings finish their iteration and save; once more to stop at once.")

    def _progress(self) -> str:
        """Describe the progress of all cells and the time left. An evaluation takes little: its cell counts as done."""
        begun = sum(job.progress()[1] if job.kind == "training" else 1.0 for job in self._running.values())
        self._display.update(self._all, completed=self._num_done + len(self._failures) + begun)
        return f"{self._num_done} of {self._num_cells} cells done, {times(self._display.tasks[0])}"

    def _print(self, text: str) -> None:
        """Print a line with the time; where nobody reads any more (``| head``), ask to stop once, as Ctrl-C does."""
        try:
            print(f"{datetime.now():%Y-%m-%d %H:%M:%S}  {text}", flush=True)
        except BrokenPipeError:
            self._stop.requested, self._unread = True, 1

    def _show(self) -> None:
        """Show a bar for all cells and one for each running step."""
        now, display = time.monotonic(), self._display
        if display.disable or now - self._shown < REDRAW_EVERY:
            return
        self._shown = now
        for bar in display.task_ids[1:]:
            display.remove_task(bar)
        text, note = self._progress().split(", ", 1)
        display.update(self._all, description=text, note=note)
        for job in self._running.values():
            doing, share, note = job.progress()
            text = f"{job.cell.name} on {job.process.place or 'no machine yet'}: {doing}"
            display.add_task(text, completed=round(100 * share), note=note)
        display.refresh()


def bars() -> Progress:
    """Return a display of bars with notes, which is shown on a terminal only."""
    name = TextColumn("{task.description}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1))
    columns = (name, BarColumn(20), TaskProgressColumn(), TextColumn("{task.fields[note]}"))
    how: dict[str, Any] = {"console": Console(highlight=False), "disable": not is_terminal(sys.stdout), "expand": True}
    return Progress(*columns, auto_refresh=False, transient=True, speed_estimate_period=SPEED_OVER, **how)


def claim_folder(matrix: Matrix, file: Path, out: Path) -> None:
    """Create the folder of the results, and copy the matrix's file into it; UserError if it has other settings."""
    check_same(matrix, out)  # before anything is created
    with held(out / "lock"):  # another process may do the same right now
        check_same(matrix, out)
        copy, text = out / SETTINGS_FILE, file.read_bytes()
        if not copy.is_file() or copy.read_bytes() != text:
            write_whole(copy, text)
