"""Progress of kernel compilation, which takes about a minute on a machine's first run."""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from typing import TextIO

import warp as wp

from legged_torque.utils.display import LINE_EVERY, Display

COMPILING = "compiling kernels, once per machine"
SHOW_AFTER = 2.0  # seconds of compilation before it is reported
_POLL = 0.25
TORCH_FOLDER = "torch"  # in the folder of Warp's cache, where torch keeps what it compiles
TORCH_COMPILES = threading.Event()  # set while torch or Triton compiles in this process


class CompileProgress(threading.Thread):
    """While this context is open, lines on standard error (or ``stream``) report that kernels are being compiled.

    "compiling kernels, once per machine: 12 modules, 34 s" is repeated every ten seconds, or is part of the view of a
    :class:`~legged_torque.utils.display.Display`. Nothing is shown if all kernels are in the cache. A thread looks for
    builds in Warp's cache, so Warp needs no change. The context may stay open for a whole training.

    Attributes:
        modules: Names of the modules that were compiled.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        """Prepare; nothing is watched yet."""
        super().__init__(name="compile progress", daemon=True)
        self.modules: set[str] = set()
        self._stream = stream or sys.stderr
        self._build = re.compile(rf"(\w+)_p{os.getpid()}_t\d+")  # folder of a build of this process
        self._seconds, self._last_look = 0.0, time.monotonic()
        self._last_line = -math.inf
        self._is_closed = threading.Event()

    def __enter__(self) -> CompileProgress:
        """Start watching."""
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop watching."""
        self._is_closed.set()
        self.join()

    def run(self) -> None:
        """Look again and again until the context is closed."""
        while not self._is_closed.wait(_POLL):
            self.look(time.monotonic())

    def look(self, now: float) -> None:
        """Look for builds at a time [s], and report them if that is due."""
        names, folder = list[str](), wp.config.kernel_cache_dir  # None before Warp's start
        for place in (folder, os.path.join(folder, "lto")) if folder else ():  # and that of link-time optimization
            with contextlib.suppress(OSError):
                names += os.listdir(place)
        builds = {found[1] for found in map(self._build.fullmatch, names) if found}
        seconds, self._last_look = now - self._last_look, now
        view = Display.shown if self._stream.isatty() else None
        if builds or TORCH_COMPILES.is_set():
            self.modules |= builds
            self._seconds += seconds
            line = f"{COMPILING}: {len(self.modules)} modules, {self._seconds:.0f} s"
            if self._seconds < SHOW_AFTER:
                return
            if view is not None:
                view.activity = line
            elif now - self._last_line >= LINE_EVERY:
                self._last_line = now
                print(line, file=self._stream, flush=True)
        elif view is not None and view.activity.startswith(COMPILING):
            view.activity = ""


@contextlib.contextmanager
def torch_compiles() -> Iterator[None]:
    """While this context is open, torch or Triton may compile, which no folder shows."""
    TORCH_COMPILES.set()
    try:
        yield
    finally:
        TORCH_COMPILES.clear()
