"""Progress of kernel compilation, which takes about a minute on a machine's first run."""

import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterator
from glob import glob
from pathlib import Path
from typing import TextIO

import warp as wp

from legged_torque.utils.display import LINE_EVERY, Display
from legged_torque.utils.errors import counted

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
        self._seconds, self._next_line = 0.0, SHOW_AFTER  # of compilation
        self._is_closed = threading.Event()

    def __enter__(self) -> "CompileProgress":
        """Start watching."""
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop watching."""
        self._is_closed.set()
        self.join()

    def run(self) -> None:
        """Look again and again until the context is closed."""
        last = time.monotonic()
        while not self._is_closed.wait(_POLL):
            now = time.monotonic()
            self.look(now - last)
            last = now

    def look(self, seconds: float) -> None:
        """Look for builds, some seconds after the last look, and report them if that is due."""
        folder, own = wp.config.kernel_cache_dir, f"*_p{os.getpid()}_t*"  # the folders of builds of this process
        places = (own, f"lto/{own}") if folder else ()  # no cache before Warp's start; lto is of link-time optimization
        builds = {Path(name).name.rpartition("_p")[0] for place in places for name in glob(place, root_dir=folder)}
        view = Display.shown if self._stream.isatty() else None
        if not builds and not TORCH_COMPILES.is_set():
            if view is not None and view.activity.startswith(COMPILING):
                view.activity = ""
            return
        self.modules |= builds
        self._seconds += seconds
        what = f"{counted(len(self.modules), 'module')}, " if self.modules else ""  # torch's have no folders
        line = f"{COMPILING}: {what}{self._seconds:.0f} s"
        if view is not None and self._seconds >= SHOW_AFTER:
            view.activity = line
        elif view is None and self._seconds >= self._next_line:
            self._next_line = self._seconds + LINE_EVERY
            print(line, file=self._stream, flush=True)


@contextlib.contextmanager
def torch_compiles() -> Iterator[None]:
    """While this context is open, torch or Triton may compile, which no folder shows."""
    TORCH_COMPILES.set()
    try:
        yield
    finally:
        TORCH_COMPILES.clear()
