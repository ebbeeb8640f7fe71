"""A loop with absolute deadlines, in a thread of its own."""

import contextlib
import gc
import os
import sys
import threading
import time
from collections.abc import Callable

import numpy as np

MISSED = 0.5  # of a period: a tick that begins this much after its time has missed it
BIN, BINS = 1e-5, 5000  # of the histogram of lateness: width [s], and number; the last one is for all that is later
PRIORITY = 20  # of real-time scheduling, 1 to 99
SWITCH = 1e-4  # seconds after which another thread gives way to the loop; Python's default is 5 ms


class RealTimeLoop:
    """Calls a function at a fixed rate, without drift, and before other programs where Linux allows it (root does).

    Attributes:
        ticks: How many there were.
        error: What has ended the loop; None if it was asked to end.
    """

    ticks = 0
    error: BaseException | None = None

    def __init__(self, rate: float, tick: Callable[[float, bool, float], None]) -> None:
        """Prepare to call ``tick`` ``rate`` times a second: with the time, whether it is late, and by how much [s]."""
        self._period, self._tick, self._ended = 1.0 / rate, tick, threading.Event()
        self._histogram = np.zeros(BINS, np.int64)
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)

    def lateness(self, share: float) -> float:
        """Return within which time of theirs a share of the ticks have begun [s]."""
        place = int(np.searchsorted(self._histogram.cumsum(), share * self.ticks))
        return min(place + 1, BINS) * BIN

    def __enter__(self) -> "RealTimeLoop":
        """Start, without pauses of the garbage collector."""
        gc.collect()
        gc.freeze()
        gc.disable()
        self._switch = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH)
        _schedule("SCHED_FIFO", PRIORITY)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """End after at most one more tick."""
        self._ended.set()
        self._thread.join()
        sys.setswitchinterval(self._switch)
        _schedule("SCHED_OTHER", 0)
        gc.enable()
        gc.unfreeze()

    def _run(self) -> None:
        """Tick until the end."""
        due = time.monotonic()
        try:
            while not self._ended.is_set():
                time.sleep(max(due - time.monotonic(), 0.0))
                begin = time.monotonic()
                late = begin - due
                missed = late > MISSED * self._period  # the tick before took too long, or the machine was halted
                self._histogram[min(int(late / BIN), BINS - 1)] += 1
                self.ticks += 1
                due = (begin if missed else due) + self._period  # what was missed is not caught up
                self._tick(begin, missed, late)
        except BaseException as error:
            self.error = error


def _schedule(policy: str, priority: int) -> None:
    """Have Linux schedule all threads so, those that receive messages as well, if it is permitted."""
    with contextlib.suppress(OSError, AttributeError):
        for thread in os.listdir("/proc/self/task"):
            os.sched_setscheduler(int(thread), getattr(os, policy), os.sched_param(priority))
