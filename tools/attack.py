"""Bad input against the scripts: runs each case in a process of its own, and judges how it was refused."""

from __future__ import annotations

import os
import runpy
import shutil
import signal
import sys
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from legged_torque import SCRIPTS_DIR

REFUSED, ACCEPTED, ENDED = "refused", "accepted", "ended"
OUTCOMES = (REFUSED, ACCEPTED, ENDED, "traceback", "crash", "timeout", "lines", "files")
"""Refused: exit status 2, one line on standard error, nothing written. Ended: another exit status and no traceback.
Crash: a signal. Lines and files: refused, but with other lines on standard error, or with something written."""
COMPILATION = ("compiling kernels", "compiled kernels")  # how lines begin that are no part of an answer
MEMORY = 8 << 30  # bytes that a case may take
TIMEOUT = 120  # seconds that a case may take: a robot of another build compiles kernels of its own
_OUTPUT, _ERROR = ".output", ".error"  # added to the name of a case's folder

Contents = dict[Path, tuple[int, int]]
"""Every file and folder below a folder, with the time of its last change [ns] and its size."""
Running = dict[int, tuple["Case", Path, Contents]]
"""By process: its case, the folder of the case and what that held before."""


@dataclass(frozen=True)
class Case:
    """A script with one bad input."""

    name: str  # what is bad, unique
    script: str  # file of scripts/
    words: tuple[str, ...]  # its command line
    must_refuse: bool = True  # whether it is wrong to accept the input
    files: dict[str, bytes] = field(default_factory=dict)  # files to write before, below the folder of the case


@dataclass(frozen=True)
class Result:
    """What became of a case."""

    case: Case
    outcome: str  # one of OUTCOMES
    error: str  # standard error

    @property
    def is_good(self) -> bool:
        """Whether the script has answered as it should."""
        return self.outcome == REFUSED or (self.outcome in (ACCEPTED, ENDED) and not self.case.must_refuse)


def attack(cases: Iterable[Case], fixture: Path, *folders: Path) -> Iterator[Result]:
    """Run every case in a copy of the folder ``fixture``, as many at a time as there are ``folders``; yield results.

    Cases are forks of this process, which must have no threads: what it has imported and compiled is there for all.
    """
    waiting, running = iter(cases), Running()
    for folder in folders:
        _start_next(waiting, fixture, folder, running)
    while running:
        process, status = os.wait()
        case, folder, before = running.pop(process)
        error = Path(f"{folder}{_ERROR}").read_text(encoding="utf-8", errors="replace")
        yield Result(case, classify(os.waitstatus_to_exitcode(status), error, before != contents(folder)), error)
        _start_next(waiting, fixture, folder, running)


def _start_next(waiting: Iterator[Case], fixture: Path, folder: Path, running: Running) -> None:
    """Start the next case in a fresh folder, and note it under its process."""
    case = next(waiting, None)
    if case is None:
        return
    process, before = start(case, fixture, folder)
    running[process] = (case, folder, before)


def start(case: Case, fixture: Path, folder: Path) -> tuple[int, Contents]:
    """Start a case in a fresh copy of ``fixture``; return its process and what its folder holds before."""
    shutil.rmtree(folder, ignore_errors=True)
    prepare(case, fixture, folder)
    before = contents(folder)
    sys.stdout.flush()
    sys.stderr.flush()
    process = os.fork()
    if not process:
        _run(case, folder)
    return process, before


def prepare(case: Case, fixture: Path, folder: Path) -> None:
    """Copy the folder ``fixture`` to a new ``folder``, and write the files of a case."""
    shutil.copytree(fixture, folder, symlinks=True)
    for name, content in case.files.items():
        (folder / name).write_bytes(content)


def _run(case: Case, folder: Path) -> None:
    """Run a script as the main program of this process, and end."""
    status = 1
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
        os.chdir(folder)
        for descriptor, name in ((1, _OUTPUT), (2, _ERROR)):
            os.dup2(os.open(f"{folder}{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(TIMEOUT)
        sys.argv = [case.script, *case.words]
        runpy.run_path(str(SCRIPTS_DIR / case.script), run_name="__main__")
        status = 0
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        else:
            status = end.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def classify(status: int, error: str, is_changed: bool) -> str:
    """Return the outcome of a case, one of :data:`OUTCOMES`.

    Args:
        status: Exit status; minus the number of the signal that ended the process.
        error: What it has written to standard error.
        is_changed: Whether files or folders were written.
    """
    lines = [line for line in error.splitlines() if not line.startswith(COMPILATION)]
    if "Traceback (most recent call last)" in error:
        return "traceback"
    if status < 0:
        return "timeout" if status == -signal.SIGALRM else "crash"
    if status != 2:
        return ENDED if status else ACCEPTED
    if len(lines) != 1 or not lines[0].startswith("error: "):
        return "lines"
    return "files" if is_changed else REFUSED


def contents(folder: Path) -> Contents:
    """Return what a folder holds: whatever is written or changed below it shows."""
    return {path: (path.lstat().st_mtime_ns, path.lstat().st_size) for path in folder.rglob("*")}


def table(results: list[Result]) -> str:
    """Return the number of cases by script and outcome, as text."""
    counts = Counter((key, result.outcome) for result in results for key in (result.case.script, "all"))
    lines = [f"{'script':<24}" + "".join(f"{outcome:>10}" for outcome in OUTCOMES) + f"{'not good':>10}"]
    for script in [*sorted({result.case.script for result in results}), "all"]:
        bad = sum(not result.is_good for result in results if script in (result.case.script, "all"))
        lines.append(f"{script:<24}" + "".join(f"{counts[script, outcome]:>10}" for outcome in OUTCOMES) + f"{bad:>10}")
    return "\n".join(lines)
