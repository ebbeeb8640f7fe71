"""Wall clock until a robot walks: ``train.py`` in a process of its own."""

from __future__ import annotations

import csv
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from legged_torque.utils.errors import TrainingError
from legged_torque.utils.runs import EVALUATIONS_FILE

TRACKING = (0.70, 0.75)
"""Shares of the commanded velocity, by ``track_percentage`` of the evaluations during training."""


def time_training(command: list[str]) -> dict[str, Any]:
    """Run a whole training, a command to which the folder of its logs is added, and return its wall clock [s].

    Returns:
        "start_s" from the command to the first iteration, "total_s" to the end of the process, "steps" of the last
        evaluation, and "reached" for each of :data:`TRACKING`, see :func:`first_reaching`.

    Raises:
        TrainingError: The process has failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        began = time.time()
        status = subprocess.run([*command, f"--log_root={folder}"], stdout=subprocess.DEVNULL).returncode
        total = time.time() - began
        if status:
            raise TrainingError(f"the training of --learn has ended with status {status}")
        (file,) = Path(folder).glob(f"*/*/{EVALUATIONS_FILE}")
        lines, written = file.read_text(encoding="utf-8").splitlines(), file.stat().st_mtime - began
    rows = [{name: float(number) for name, number in row.items()} for row in csv.DictReader(lines)]
    start = written - rows[-1]["seconds"]
    reached = [first_reaching(share, rows, start) for share in TRACKING]
    return {"start_s": start, "total_s": total, "steps": int(rows[-1]["steps"]), "reached": reached}


def first_reaching(share: float, rows: list[dict[str, float]], start: float) -> dict[str, float | None]:
    """Return when tracking was first at or above a share, of the rows of evaluations; None if it never was.

    "training_s" is the time since the first iteration, which began ``start`` seconds after the command, and "command_s"
    that since the command.
    """
    for row in rows:
        if row["track_percentage"] >= share:  # not if it is NaN
            times = {"training_s": row["seconds"], "command_s": start + row["seconds"]}
            return {"share": share, "steps": int(row["steps"]), **times}
    return {"share": share, "steps": None, "training_s": None, "command_s": None}
