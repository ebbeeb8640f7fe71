"""Learning curves: the metrics of a policy over the steps of its training, read from all files that hold them."""

from __future__ import annotations

import csv
import gzip
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from legged_torque.utils.errors import UserError
from legged_torque.utils.metrics import METRICS, Metric
from legged_torque.utils.plotting import read_data
from legged_torque.utils.runs import load_config

MAX_BYTES = 50_000_000  # of a CSV file; a small compressed one may hold more than memory does
MILLION = 1e6  # steps in a million, the unit of axes and texts
CURVE_METRICS = (*METRICS, Metric("critic_gradient_norm", "", "Gradient norm of the critic", None))
"""The metrics of an evaluation during training."""
LEVEL = Metric("terrain_level", "", "Mean level of robots in training", None)
"""What such an evaluation notes on rough ground as well."""

Row = dict[str, float]
"""One evaluation: "steps", "seconds" of training, :data:`CURVE_METRICS`, :data:`LEVEL`; NaN where there is nothing."""


@dataclass
class LearningCurve:
    """The evaluations of one training, in the order of training. Some files do not name its environment."""

    task: str
    seed: int
    environment: str = ""
    rows: list[Row] = field(default_factory=list)

    def __str__(self) -> str:
        """Name the training."""
        return ", ".join(filter(None, [self.task, self.environment, f"seed {self.seed}"]))


def read_curves(file: Path) -> list[LearningCurve]:
    """Read JSON of ``evaluate.py``, a run's ``evaluations.csv`` or a report's (.gz); a UserError if it is none."""
    training: dict[str, Any] = {}
    curves: dict[tuple, LearningCurve] = {}  # a report's file holds many trainings
    try:
        if file.suffix == ".json":
            training = read_data(file, {"task", "seed", "points"}, "evaluate.py")
            entries = training["points"]
        else:
            entries = read_csv(file)
            if entries and "task" not in entries[0]:
                config = load_config(file.parent)
                training = {"task": config["task"], "seed": config["train"]["seed"]}
        for entry in entries:
            names = training or entry
            key = (str(names["task"]), int(names["seed"]), str(names.get("environment", "")))
            curves.setdefault(key, LearningCurve(*key)).rows.append(to_row(entry))
    except (LookupError, ValueError, TypeError, AttributeError, OverflowError) as error:
        raise UserError(f"'{file}' does not hold learning curves: {error!r}") from None
    return list(curves.values())


def read_csv(file: Path) -> list[dict[str, Any]]:
    """Read a CSV file, compressed or not. A last line without its end was cut off by a kill and is left out."""
    try:
        with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise UserError(f"cannot read '{file}': it has more than {MAX_BYTES} bytes, compressed or not")
        text = content.decode("utf-8", errors="replace")
        return list(csv.DictReader(text.rpartition("\n")[0].splitlines()))
    except (OSError, EOFError, zlib.error, csv.Error) as error:
        raise UserError(f"cannot read '{file}': {error}") from None


def read_rows(file: Path, notes: list[str]) -> list[Row]:
    """Return the evaluations of a run; none if the file is missing. Each unreadable line adds a note."""
    rows = []
    for number, line in enumerate(read_csv(file) if file.is_file() else [], start=2):
        try:
            if None in line or None in line.values():
                raise ValueError("too many or too few cells")
            rows.append(to_row(line))
        except (LookupError, ValueError, OverflowError):
            notes.append(f"line {number} of '{file}' cannot be read")
    return rows


def to_row(entry: Mapping[str, Any]) -> Row:
    """Return an evaluation from the cells of a line or the entries of a JSON object; empty ones are NaN."""
    cells = {name: entry.get(name) for name in ("seconds", *(metric.name for metric in (*CURVE_METRICS, LEVEL)))}
    values = {name: math.nan if cell in (None, "") else float(cell) for name, cell in cells.items()}
    return {"steps": int(float(entry["steps"])), **values}
