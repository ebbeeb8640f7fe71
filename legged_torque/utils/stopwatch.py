"""Where the seconds of a command go, by stage: ``train.py --timing`` prints it."""

import os
import time
from pathlib import Path


class Stopwatch:
    """Seconds of this process by stage, from its start on.

    Attributes:
        seconds: Those of each stage, in the order in which stages first ended.
    """

    def __init__(self) -> None:
        """Begin with the first stage."""
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter() - _process_age()

    def lap(self, stage: str) -> None:
        """End a stage: it has the time since the end of the one before. It may go on later."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now

    def __str__(self) -> str:
        """List all stages."""
        return ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in self.seconds.items())


def _process_age() -> float:
    """Return the seconds since this process began; 0 where the system has no ``/proc`` to say so."""
    try:
        began = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
        return time.clock_gettime(time.CLOCK_BOOTTIME) - began
    except (OSError, AttributeError):
        return 0.0


stopwatch = Stopwatch()
"""That of this process."""
