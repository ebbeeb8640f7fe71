"""Device time of an experiment: a small file per cell, which outlives kills."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from datetime import timedelta
from pathlib import Path

from legged_torque.utils.files import write_whole

TIMES_FILE = "times.json"


@dataclass
class Times:
    """Device time of a cell, or of several, over all calls of the experiment."""

    steps: int = 0  # of its training up to the last checkpoint, over all worlds
    seconds: dict[str, float] = field(default_factory=dict)  # [s] by "gpu training", "cpu evaluation", ...
    """A process that shares its device with n - 1 others of the experiment counts an n-th of its time."""

    def add(self, kind: str, seconds: float) -> None:
        """Count device time [s] of a kind."""
        self.seconds[kind] = self.seconds.get(kind, 0.0) + seconds


def read_times(folder: Path) -> Times:
    """Return the times of a cell's folder; none if it has no such file, or an unreadable one."""
    try:
        values = json.loads((folder / TIMES_FILE).read_text(encoding="utf-8"))
        return Times(int(values["steps"]), {str(key): float(number) for key, number in values["seconds"].items()})
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return Times()


def write_times(folder: Path, times: Times) -> None:
    """Write the file of a cell; a UserError if that is not possible."""
    write_whole(folder / TIMES_FILE, (json.dumps(asdict(times)) + "\n").encode())


def add_up(parts: Iterable[Times]) -> Times:
    """Return the sum over cells."""
    total = Times()
    for part in parts:
        total.steps += part.steps
        for kind, seconds in part.seconds.items():
            total.add(kind, seconds)
    return total


def describe(total: Times) -> str:
    """Return a line on device time, steps and steps per second; empty if there is no time."""
    texts = []
    for kind, seconds in sorted(total.seconds.items()):
        device, _, step = kind.partition(" ")
        texts.append(f"{timedelta(seconds=round(seconds))} of {device.upper()} time for {step}")
    training = sum(seconds for kind, seconds in total.seconds.items() if kind.endswith("training"))
    if training and total.steps:
        texts.append(f"{total.steps} steps of training, {total.steps / training:.0f} per second of their device time")
    return "; ".join(texts)
