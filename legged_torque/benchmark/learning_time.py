"""Wall clock until a robot walks: ``train.py`` in a process of its own, watched from outside."""

from __future__ import annotations

import csv
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from legged_torque.utils.errors import TrainingError
from legged_torque.utils.runs import CONFIG_FILE, EVALUATIONS_FILE

TRACKING = (0.70, 0.75)
"""Shares of the commanded velocity, by ``track_percentage`` of the evaluations during training."""
_LOOK = 0.01  # seconds between two looks at the evaluations


def time_training(command: list[str]) -> dict[str, Any]:
    """Run a whole training, a command to which the folder of its logs is added, and return its wall clock [s].

    "start_s" is from the command to the start of training, when the run's folder appears, "total_s" that to the end of
    the process. "steps" are those of the last evaluation. "reached" are, for each of :data:`TRACKING`, "steps" of the
    first evaluation at or above it, "training_s" until then from the start of training, and "command_s" from the
    command; None if no evaluation reached it. A TrainingError if the process fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        began = time.time()
        process = subprocess.Popen([*command, f"--log_root={folder}"], stdout=subprocess.DEVNULL)
        try:
            ends = watch(process, Path(folder))
            total = time.time() - began
        finally:
            process.terminate()  # after Ctrl-C
            process.wait()
        if process.returncode:
            raise TrainingError(f"the training of --learn has ended with status {process.returncode}")
        (config,) = Path(folder).glob(f"*/*/{CONFIG_FILE}")
        rows = list(csv.DictReader(config.with_name(EVALUATIONS_FILE).read_text(encoding="utf-8").splitlines()))
        start = config.stat().st_mtime
    evaluations = [(int(r["steps"]), float(r["track_percentage"]), end) for r, end in zip(rows, ends, strict=True)]
    reached = [first_reaching(share, evaluations, start, began) for share in TRACKING]
    return {"start_s": start - began, "total_s": total, "steps": evaluations[-1][0], "reached": reached}


def watch(process: subprocess.Popen, folder: Path) -> list[float]:
    """Wait for the end of a training and return when each of its evaluations was written, by ``time.time()``."""
    ends: list[float] = []
    running = True
    while running:
        running = process.poll() is None  # what is written before the end is seen after it
        for file in folder.glob(f"*/*/{EVALUATIONS_FILE}"):
            written = file.stat().st_mtime
            rows = file.read_bytes().count(b"\n") - 1
            ends += [written] * (rows - len(ends))
        time.sleep(_LOOK)
    return ends


def first_reaching(
    share: float, evaluations: list[tuple[int, float, float]], start: float, began: float
) -> dict[str, float | None]:
    """Return when tracking was first at or above a share; evaluations are (steps, tracking, time of its end)."""
    for steps, tracking, end in evaluations:
        if tracking >= share:  # not if it is NaN
            return {"share": share, "steps": steps, "training_s": end - start, "command_s": end - began}
    return {"share": share, "steps": None, "training_s": None, "command_s": None}
