"""Keeping steps in time with a clock."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

MAX_LAG = 0.25
"""Seconds behind its schedule after which a :class:`Pacer` forgets what it has missed instead of catching up."""


class Pacer:
    """Lets control steps begin when they are due, and measures how fast they really come.

    Attributes:
        speed: Simulated seconds per second that are asked for: 1 is real time.
    """

    def __init__(
        self,
        dt: float,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Start without a schedule: the first step is due at once.

        Args:
            dt: Simulated time of a step [s].
            clock: Returns the time [s].
            sleep: Waits for some seconds.
        """
        self.speed = 1.0
        self._dt, self._clock, self._sleep = dt, clock, sleep
        self._due: float | None = None
        self._begun: deque[float] = deque(maxlen=51)

    def wait(self) -> None:
        """Return when the next step is due. After a longer delay the schedule starts anew, without a rush."""
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
