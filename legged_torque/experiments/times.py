"""Device time of an experiment: a small file per cell, which outlives kills."""

import json
from collections import Counter
from collections.abc import Iterable
from datetime import timedelta
from pathlib import Path

from legged_torque.utils.files import write_whole

TIMES_FILE = "times.json"
STEPS = "steps"

Times = dict[str, float]
"""Device time [s] of a cell by "gpu training", "cpu evaluation" and so on, over all calls of the experiment; a process
that shares its device with n - 1 others of the experiment counts an n-th of its time. :data:`STEPS` are those of its
training up to the last checkpoint, over all worlds."""


def read_times(folder: Path) -> Times:
    """Return the times of a cell's folder; none if it has no such file, or an unreadable one."""
    try:
        values = json.loads((folder / TIMES_FILE).read_text(encoding="utf-8"))
        seconds = {str(kind): float(number) for kind, number in values["seconds"].items()}
        return seconds | {STEPS: int(values[STEPS])}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return {}


def write_times(folder: Path, times: Times) -> None:
    """Write the file of a cell; a UserError if that is not possible."""
    seconds = {kind: number for kind, number in times.items() if kind != STEPS}
    write_whole(folder / TIMES_FILE, json.dumps({STEPS: times.get(STEPS, 0), "seconds": seconds}) + "\n")


def describe(times: Iterable[Times]) -> str:
    """Return a line on device time, steps and steps per second of all cells; empty if there is no time."""
    total = Counter[str]()
    for each in times:
        total.update(each)
    steps, texts = total.pop(STEPS, 0), []
    for kind, seconds in sorted(total.items()):
        device, _, step = kind.partition(" ")
        texts.append(f"{timedelta(seconds=round(seconds))} of {device.upper()} time for {step}")
    training = sum(seconds for kind, seconds in total.items() if kind.endswith("training"))
    if training and steps:
        texts.append(f"{steps} steps of training, {steps / training:.0f} per second of their device time")
    return "; ".join(texts)
