"""Steps in real time."""

import math
import time
from collections import deque
from collections.abc import Callable

MAX_LAG = 0.25  # seconds behind schedule after which steps are dropped instead of caught up
AVERAGED = 50  # steps over which the actual rate is measured


class Pacer:
    """Starts control steps when they are due and measures their actual rate.

    Attributes:
        speed: Wanted simulated seconds per second; 1 is real time.
        rate: Actual ones over the last :data:`AVERAGED` steps; 0 before there are two.
    """

    speed, rate = 1.0, 0.0

    def __init__(
        self, dt: float, clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        """Start without a schedule: the first step, of ``dt`` simulated seconds, is due at once."""
        self._dt, self._clock, self._sleep = dt, clock, sleep
        self.restart()

    def restart(self) -> None:
        """Forget the schedule, after a pause."""
        self._due = -math.inf
        self._begun: deque[float] = deque(maxlen=AVERAGED + 1)

    def wait(self) -> None:
        """Wait until the next step is due. A delay of more than :data:`MAX_LAG` is not caught up."""
        now = self._clock()
        self._due = now if now - self._due > MAX_LAG else self._due
        if self._due > now:
            self._sleep(self._due - now)
        self._due += self._dt / self.speed
        self._begun.append(self._clock())
        self.rate = (len(self._begun) - 1) * self._dt / max(self._begun[-1] - self._begun[0], 1e-9)
