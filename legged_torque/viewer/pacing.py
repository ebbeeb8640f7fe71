"""Keeping steps in time with a clock, until Ctrl-C."""

from __future__ import annotations

import contextlib
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator

MAX_LAG = 0.25  # seconds behind schedule after which a new schedule starts instead of catching up


class Pacer:
    """Starts control steps when they are due, and measures their actual rate."""

    def __init__(
        self, dt: float, clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        """Start without a schedule: the first step, of ``dt`` simulated seconds, is due at once."""
        self.speed = 1.0  # the wanted one, in simulated seconds per second; 1 is real time
        self._dt, self._clock, self._sleep = dt, clock, sleep
        self._due: float | None = None
        self._begun: deque[float] = deque(maxlen=51)

    def wait(self) -> None:
        """Wait until the next step is due. After a delay of more than :data:`MAX_LAG` the schedule starts anew."""
        now = self._clock()
        if self._due is None or now - self._due > MAX_LAG:
            self._due = now
        if self._due > now:
            self._sleep(self._due - now)
        self._due += self._dt / self.speed
        self._begun.append(self._clock())

    def restart(self) -> None:
        """Forget the schedule, after a pause."""
        self._due = None
        self._begun.clear()

    def achieved(self) -> float:
        """Return simulated seconds per second over the last 50 steps; 0 before there are two."""
        if len(self._begun) < 2:
            return 0.0
        return (len(self._begun) - 1) * self._dt / max(self._begun[-1] - self._begun[0], 1e-9)


@contextlib.contextmanager
def stopping_on_ctrl_c(stop: Callable[[], None]) -> Iterator[None]:
    """While this context is open, Ctrl-C or SIGTERM calls a function; a second Ctrl-C ends the program at once."""

    def handle(number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        stop()

    old = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
