"""Progress of kernel compilation, which takes about a minute on a machine's first run."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import warp as wp

from legged_torque.utils.display import Display

SHOW_AFTER = 2.0  # seconds of compilation before a line is shown; shorter compilations are not reported
QUIET_AFTER = 5.0  # seconds without compilation after which the line is finished
END_AFTER = 120.0  # seconds without compilation after which watching ends, so that it costs a long training nothing
_POLL = 0.25
TORCH_FOLDER = "torch"  # in the folder of Warp's cache, where torch keeps what it compiles
TORCH_COMPILES = threading.Event()  # set while torch or Triton compiles in this process
_BUILD = re.compile(r"_p(\d+)_t\d+$")  # end of the name of a build folder: process id, thread


class CompileProgress:
    """While this context is open, a line on standard error (or ``stream``) reports that kernels are being compiled.

    The line reads "compiling kernels, once per machine: 12 modules, 34 s". It is rewritten every second in a
    terminal, or part of the picture that a :class:`~legged_torque.utils.display.Display` shows there, and repeated
    every ten seconds elsewhere. Nothing is shown if all kernels are in Warp's cache. A thread
    watches the folder of the cache, so Warp needs no change. The context may stay open for a whole training.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        """Prepare; nothing is watched yet."""
        self.modules = 0  # added to the cache since the context was opened
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._interval = 1.0 if self._terminal else 10.0
        self._folder: str | None = None
        self._before: dict[str, int] = {}
        self._last_build = -1e9
        self._seconds = 0.0
        self._last_line: float | None = None  # time of the last update of an unfinished line
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="compile progress", daemon=True)

    def __enter__(self) -> CompileProgress:
        """Start watching."""
        self._is_compiling()
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop watching, and finish the line if there is one."""
        self._stop.set()
        self._thread.join()
        self._is_compiling()  # count modules since the last look
        self._finish_line()

    def _watch(self) -> None:
        """Watch and report until the context is closed, or until nothing is compiled for :data:`END_AFTER`."""
        start = time.monotonic()
        while not self._stop.wait(_POLL):
            now = time.monotonic()
            pause = now - self._last_build
            if self._is_compiling():
                self._seconds += pause if pause < QUIET_AFTER else _POLL
                self._last_build = now
                if self._seconds >= SHOW_AFTER and now - (self._last_line or -1e9) >= self._interval:
                    self._last_line = now
                    # the cursor returns to the start of the line, so that later output covers it
                    self._write("compiling kernels, once per machine", "\r" if self._terminal else "\n")
            elif now - max(start, self._last_build) > END_AFTER:
                return
            elif pause > QUIET_AFTER:
                self._finish_line()

    def _is_compiling(self) -> bool:
        """Count the new modules in the cache, and return whether this process is building one now."""
        folder = wp.config.kernel_cache_dir
        if folder is None:  # Warp is not initialized yet
            return False
        entries = _entries(folder)
        others = ("lto", TORCH_FOLDER)
        modules = {n: time_ns for n, time_ns in entries.items() if n not in others and not _BUILD.search(n)}
        if folder != self._folder:
            self._folder, self._before = folder, modules
        # a module that exists for another GPU keeps its name when it is built for this one; its time changes
        self.modules = sum(self._before.get(name) != time_ns for name, time_ns in modules.items())
        builds = (_BUILD.search(name) for name in [*entries, *_entries(os.path.join(folder, "lto"))])
        is_ours = any(build and int(build[1]) == os.getpid() for build in builds)  # other processes share the cache
        return is_ours or TORCH_COMPILES.is_set()

    def _write(self, text: str, end: str) -> None:
        """Write a line with the progress, or let it be part of a picture."""
        line = f"{text}: {self.modules} modules, {self._seconds:.0f} s"
        shown = Display.shown
        if self._terminal and shown is not None:
            shown.activity = "" if end.endswith("\n") else line
            return
        self._stream.write(line + end)
        self._stream.flush()

    def _finish_line(self) -> None:
        """Replace an unfinished line with its final text, if there is one."""
        if self._last_line is not None:
            self._last_line = None
            self._write("compiled kernels", " " * 40 + "\n" if self._terminal else "\n")


@contextlib.contextmanager
def torch_compiles() -> Iterator[None]:
    """While this context is open, torch or Triton may compile, which no folder shows."""
    TORCH_COMPILES.set()
    try:
        yield
    finally:
        TORCH_COMPILES.clear()


def _entries(folder: str) -> dict[str, int]:
    """Return the entries of a folder with their times of modification [ns]; nothing if the folder is missing."""
    result: dict[str, int] = {}
    with contextlib.suppress(OSError):
        for path in Path(folder).iterdir():
            with contextlib.suppress(OSError):  # moved in the meantime
                result[path.name] = path.stat().st_mtime_ns
    return result
