"""How many cores of the machine other processes keep busy while this one runs, as Linux counts."""

from __future__ import annotations

import os
from pathlib import Path

COUNTS = Path("/proc/stat")
LEAST = 1.0  # seconds of observation that say something
MANY = 0.3  # busy cores from which others are in the way


class BusyCores:
    """Observes from its creation on; costs nothing meanwhile."""

    def __init__(self, counts: Path = COUNTS) -> None:
        """Start to observe; elsewhere than on Linux nothing is seen. ``counts`` is the system's file."""
        self._counts = counts
        self._start = self._now()

    def of_others(self) -> float | None:
        """Return how many cores others have kept busy on average; None if that is not known, or too early to say."""
        seconds, busy, own = (now - then for now, then in zip(self._now(), self._start, strict=True))
        return max(busy - own, 0.0) / seconds if seconds >= LEAST else None

    def note(self, threads: int) -> str | None:
        """Return what a user should know who computes with so many threads, or None if there is nothing."""
        others, cores = self.of_others(), os.cpu_count() or 1
        if others is None or others < MANY or threads <= 1 or threads <= cores - others:
            return None
        return (
            f"other processes use {others:.1f} of {cores} cores, and torch has {threads} threads, which wait for each "
            "other: OMP_NUM_THREADS=1 is likely faster"
        )

    def _now(self) -> tuple[float, float, float]:
        """Return how long the cores have run, how long they were busy in sum, and for this process [s]."""
        try:
            numbers = [int(number) for number in self._counts.read_text().split("\n", 1)[0].split()[1:]]
        except (OSError, ValueError):
            return 0.0, 0.0, 0.0
        ticks = os.sysconf("SC_CLK_TCK")  # counts per second of a core
        cores, idle = sum(numbers[:8]) / ticks, sum(numbers[3:5]) / ticks  # what guests use is in others already
        return cores / (os.cpu_count() or 1), cores - idle, sum(os.times()[:4])
