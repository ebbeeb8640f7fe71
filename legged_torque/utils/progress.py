"""Telling the user that kernels are being compiled, which takes about a minute on a machine's first run."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import threading
import time
from types import TracebackType
from typing import TextIO

import warp as wp

SHOW_AFTER = 2.0
"""Seconds of compilation before anything is said: less is not worth a line."""
QUIET_AFTER = 5.0
"""Seconds without compilation after which it counts as over for now."""
END_AFTER = 120.0
"""Seconds without compilation after which the watching ends for good: a long training pays nothing for it."""
_POLL = 0.25
_BUILD = re.compile(r"_p(\d+)_t\d+$")  # ends the name of a folder in which the process of that number builds


class CompileProgress:
    """While this context is open, a line on standard error tells that kernels are being compiled.

    It reads "compiling physics kernels, once per machine: 12 modules, 34 s", is rewritten every second in a terminal
    and written anew every ten seconds elsewhere. Nothing is shown if all kernels are in Warp's cache already. A thread
    looks at the folder of that cache, so that nothing of Warp is changed. The context may stay open for a whole
    training.

    Attributes:
        modules: Modules that were added to the cache since the context was opened.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        """Prepare; nothing is watched yet.

        Args:
            stream: Where to write; None is standard error.
        """
        self.modules = 0
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._interval = 1.0 if self._terminal else 10.0
        self._folder: str | None = None
        self._before: dict[str, int] = {}
        self._last_build = -1e9
        self._seconds = 0.0
        self._last_line: float | None = None  # when the line that is not finished yet was last written
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="compile progress", daemon=True)

    def __enter__(self) -> CompileProgress:
        """Begin to watch."""
        self._is_compiling()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Stop watching, and finish the line if there is one."""
        self._stop.set()
        self._thread.join()
        self._is_compiling()  # counts what has come since the last look
        self._finish_line()

    def _watch(self) -> None:
        """Look and tell until the context is closed or nothing was compiled for long."""
        start = time.monotonic()
        while not self._stop.wait(_POLL):
            now = time.monotonic()
            if self._is_compiling():
                pause = now - self._last_build
                self._seconds += pause if pause < QUIET_AFTER else _POLL
                self._last_build = now
                self._write_line(now)
            elif now - max(start, self._last_build) > END_AFTER:
                return
            elif now - self._last_build > QUIET_AFTER:
                self._finish_line()

    def _is_compiling(self) -> bool:
        """Count the new modules of the cache, and return whether this process is building one at this moment."""
        folder = wp.config.kernel_cache_dir
        if folder is None:  # as long as Warp is not initialized
            return False
        entries = _entries(folder)
        modules = {name: time_ns for name, time_ns in entries.items() if not _BUILD.search(name)}
        if folder != self._folder:
            self._folder, self._before = folder, modules
        # a module that is there for another GPU keeps its name when it is built for this one, but its time changes
        self.modules = sum(self._before.get(name) != time_ns for name, time_ns in modules.items() if name != "lto")
        builds = (_BUILD.search(name) for name in [*entries, *_entries(os.path.join(folder, "lto"))])
        return any(build and int(build[1]) == os.getpid() for build in builds)  # other processes share the cache

    def _write_line(self, now: float) -> None:
        """Tell how far it is, if that is due."""
        if self._seconds < SHOW_AFTER or (self._last_line is not None and now - self._last_line < self._interval):
            return
        self._last_line = now
        line = f"compiling physics kernels, once per machine: {self.modules} modules, {self._seconds:.0f} s"
        # the cursor goes back to the start of the line, so that whatever is printed next covers it
        self._stream.write(f"{line}\r" if self._terminal else f"{line}\n")
        self._stream.flush()

    def _finish_line(self) -> None:
        """Put a last line in place of the one that was rewritten, if there is one."""
        if self._last_line is None:
            return
        self._last_line = None
        line = f"compiled physics kernels: {self.modules} modules, {self._seconds:.0f} s"
        self._stream.write(f"{line:<80}\n" if self._terminal else f"{line}\n")
        self._stream.flush()


def _entries(folder: str) -> dict[str, int]:
    """Return what is in a folder, each with the time of its last change [ns]; nothing if there is no such folder."""
    result = {}
    try:
        names = os.listdir(folder)
    except OSError:
        return result
    for name in names:
        with contextlib.suppress(OSError):  # moved while we looked
            result[name] = os.stat(os.path.join(folder, name)).st_mtime_ns
    return result
