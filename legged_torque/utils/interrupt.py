"""Stopping on Ctrl-C without losing work."""

import contextlib
import os
import signal
import stat
import threading
from collections.abc import Callable
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, the system's request to end, and a terminal that is closed."""


class StopRequest:
    """While this context is open, the first signal of :data:`SIGNALS` requests a stop; the second stops at once.

    A terminal that closes may send its signal twice, which is still a request; under ``nohup`` it is ignored.
    """

    requested = False  # whether a signal has arrived
    number = 0  # of that signal

    def __init__(self, notify: Callable[[str], None] | None = None) -> None:
        """Prepare; ``notify`` shows a line when the stop is requested, by default on standard error."""
        self._notify = notify or write_error

    def __enter__(self) -> "StopRequest":
        """Take over the signals; only a process's main thread can do so."""
        self._old = {}
        if threading.current_thread() is threading.main_thread():
            ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            taken = [number for number in SIGNALS if not (number is signal.SIGHUP and ignored)]
            self._old = {number: signal.signal(number, self._receive) for number in taken}
        return self

    def __exit__(self, *exception: object) -> None:
        """Restore the previous handlers of the signals."""
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal; drop all further output to a terminal that is closed, where every write would fail."""
        for stream in (1, 2) if number == signal.SIGHUP else ():
            with contextlib.suppress(OSError):
                if stat.S_ISCHR(os.fstat(stream).st_mode):  # isatty is false for a terminal that is closed
                    os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        self._handle(number)

    def _handle(self, number: int) -> None:
        """Note the first signal; interrupt at the second."""
        if self.requested and number != signal.SIGHUP:
            raise KeyboardInterrupt
        self.requested, self.number = True, self.number or number
        self._notify("Stopping after this iteration and saving; once more to stop at once.")


def write_error(text: str) -> None:
    """Write a line to standard error from a signal's handler, where print fails inside another print.

    The reader of a pipe may have ended by the same Ctrl-C; that must not end what is to be saved.
    """
    with contextlib.suppress(OSError):
        os.write(2, f"\n{text}\n".encode())
