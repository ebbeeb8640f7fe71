"""Stopping on Ctrl-C without losing work."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType


class StopRequest:
    """While this context is open, the first Ctrl-C or SIGTERM only asks to stop; the second one stops at once."""

    requested = False  # whether a signal has asked to stop

    def __enter__(self) -> StopRequest:
        """Take over the signals; only a process's main thread can do so."""
        self._old = {}
        if threading.current_thread() is threading.main_thread():
            self._old = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *exception: object) -> None:
        """Restore the previous handlers of the signals."""
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        """Note the first signal; interrupt at the second."""
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        # print fails inside another print
        os.write(2, b"\nStopping after this iteration and saving; once more to stop at once.\n")
