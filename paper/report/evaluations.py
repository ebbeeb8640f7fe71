"""Evaluations during training, as tables with a row per evaluation, from every file that holds them."""

import csv
import gzip
import zlib
from pathlib import Path

import numpy as np
import pandas as pd

from legged_torque.paper.metrics import METRICS, Metric
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import load_config

MILLION = 1e6  # steps in a million, the unit of texts and figures
MAX_BYTES = 50_000_000  # of a CSV file; a small compressed one may hold more than fits in memory
CURVE_METRICS = (*METRICS, Metric("critic_gradient_norm", "Gradient norm of the critic", None))
"""The metrics of an evaluation during training."""
LEVEL = Metric("terrain_level", "Mean level of robots in training", None)
"""Also recorded in an evaluation during training on rough ground."""
METRIC_NAMES = [metric.name for metric in CURVE_METRICS]
COLUMNS = ["steps", "seconds", *METRIC_NAMES, LEVEL.name]
"""Columns of tables of evaluations: environment steps, seconds of training, metrics; NaN if missing or not finite."""


def read_curves(file: Path) -> pd.DataFrame:
    """Read learning curves: a run's ``evaluations.csv``, or a report's (.gz).

    Returns:
        :data:`COLUMNS` and the columns task, environment and seed; the environment is "" if the file does not name it.

    Raises:
        UserError: If the file holds no learning curves.
    """
    problems: list[str] = []
    try:
        texts, training = read_csv(file, problems), {}
        table, unnamed = to_numbers(texts, file, problems), pd.Series("", texts.index)
        if "task" not in texts and not table.empty:
            config = load_config(file.parent)
            training = {"task": config["task"], "seed": config["train"]["seed"]}
        for name, kind in {"task": str, "environment": str, "seed": int}.items():
            table[name] = kind(training[name]) if name in training else texts.get(name, unnamed).map(kind)
    except (LookupError, ValueError, TypeError, AttributeError, OverflowError) as error:
        problems.append(f"cannot read '{file}' as learning curves: {error!r}")
    if problems or table.empty:
        raise UserError(problems[0] if problems else f"'{file}' holds no evaluations")
    return table


def read_evaluations(file: Path, problems: list[str]) -> pd.DataFrame:
    """Return the evaluations of a run, by :data:`COLUMNS`; none if the file is missing.

    A message is added to ``problems`` for each line that cannot be read.
    """
    texts = read_csv(file, problems) if file.is_file() else pd.DataFrame(columns=COLUMNS)
    return to_numbers(texts, file, problems)


def read_csv(file: Path, problems: list[str]) -> pd.DataFrame:
    """Return the cells of a CSV file, compressed or not, as texts by line number.

    A last line without a line end was cut off when the process was killed, and is left out.
    """
    try:
        with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise UserError(f"cannot read '{file}': it has more than {MAX_BYTES} bytes, compressed or not")
        text = content.decode("utf-8", errors="replace").rpartition("\n")[0]
        header, *lines = list(csv.reader(text.splitlines())) or [[]]
    except (OSError, EOFError, zlib.error, csv.Error) as error:
        raise UserError(f"cannot read '{file}': {error}") from None
    whole = {number: line for number, line in enumerate(lines, start=2) if len(line) == len(header)}
    problems += [f"row {i} of '{file}' cannot be read" for i in range(2, len(lines) + 2) if i not in whole]
    return pd.DataFrame.from_dict(whole, orient="index", columns=header, dtype=object)


def to_numbers(texts: pd.DataFrame, file: Path, problems: list[str]) -> pd.DataFrame:
    """Return the rows whose cells are numbers or empty, by :data:`COLUMNS`; others add a message to ``problems``."""
    if "steps" not in texts or not texts.columns.is_unique:
        problems.append(f"cannot read '{file}': it has no column 'steps', or two columns of the same name")
        return pd.DataFrame(columns=COLUMNS, dtype=float)
    cells = texts.reindex(columns=COLUMNS)
    values = cells.apply(pd.to_numeric, errors="coerce").astype(float)
    is_text = values.isna() & cells.notna() & ~cells.isin(["", "nan"])
    is_wrong = is_text.any(axis=1) | ~values["steps"].between(0, 2**53)
    problems += [f"row {number} of '{file}' cannot be read" for number in values.index[is_wrong]]
    return values[~is_wrong].replace([np.inf, -np.inf], np.nan).astype({"steps": "int64"})
