"""Where the seconds of a command go, by stage: ``train.py --timing`` prints it."""

import contextlib
import os
import time
from pathlib import Path


class Stopwatch:
    """Seconds of this process by stage, from its start on.

    Attributes:
        seconds: Those of each stage, in the order in which stages first ended.
    """

    def __init__(self) -> None:
        """Begin with the first stage, where the process began; now, where the system has no ``/proc`` to say when."""
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()
        with contextlib.suppress(OSError, AttributeError):
            began = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
            self._last -= time.clock_gettime(time.CLOCK_BOOTTIME) - began

    def lap(self, stage: str) -> None:
        """End a stage: it has the time since the end of the one before. It may go on later."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now

    def __str__(self) -> str:
        """List all stages."""
        return ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in self.seconds.items())


stopwatch = Stopwatch()
"""That of this process."""
