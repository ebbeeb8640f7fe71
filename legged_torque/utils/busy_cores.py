"""A hint for trainings on a CPU whose cores are busy with other processes."""

from __future__ import annotations

import os
import time
from pathlib import Path

COUNTS = Path("/proc/stat")
MANY = 0.3  # busy cores from which on others are in the way
SECONDS = 0.3  # of observation


def busy_cores() -> float | None:
    """Return how many cores other processes use, while this one sleeps a moment; None elsewhere than on Linux."""
    try:
        start = _busy_seconds()
        time.sleep(SECONDS)
        return (_busy_seconds() - start) / SECONDS
    except (OSError, ValueError):
        return None


def busy_cores_note(threads: int) -> str | None:
    """Return a note on computing with so many threads; None if enough cores are free."""
    cores = os.cpu_count() or 1
    others = busy_cores() if threads > 1 else None
    if others is None or others < MANY or threads <= cores - others:
        return None
    return (
        f"other processes use {others:.1f} of {cores} cores, and torch has {threads} threads, which wait for each "
        "other: OMP_NUM_THREADS=1 is likely faster"
    )


def _busy_seconds() -> float:
    """Return how long all cores together have been busy since the machine was started [s]."""
    ticks = [int(number) for number in COUNTS.read_text().split("\n", 1)[0].split()[1:9]]
    return (sum(ticks) - sum(ticks[3:5])) / os.sysconf("SC_CLK_TCK")  # all but idle and waiting for disks
