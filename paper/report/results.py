"""The results of an experiment: reads its folder, averages over seeds, compares tasks, writes tables."""

from __future__ import annotations

import csv
import gzip
import io
import json
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from legged_torque.experiments.matrix import ROUGH_GROUND, SETTINGS_FILE, Cell, Matrix, read_plan
from legged_torque.paper.report.curves import CURVE_METRICS, Row, read_rows, to_row
from legged_torque.paper.report.grounds import MEASURES, Crossings, read_crossings
from legged_torque.paper.report.report_runs import find_trainings, plan_of, ranges_of
from legged_torque.paper.values import ENVIRONMENTS, PAPER_TASKS, paper_value
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import CONFIG_FILE, load_config, steps_per_iteration

LAST_SHARE = 0.18
"""Fraction of final evaluations averaged for unfinished runs: that of steps 90 to 110 million in a whole one."""
PAPER_STEPS = 110_000_000
TABLE_FILE = "table.csv"
EVALUATIONS_FILE = "evaluations.csv.gz"
GROUNDS_FILE = "grounds.csv"


@dataclass
class CellResult:
    """What there is of a training that has begun."""

    cell: Cell
    rows_in: dict[str, list[Row]] = field(default_factory=dict)  # evaluations during training, by environment
    results: dict[str, Row] = field(default_factory=dict)  # evaluations of the last checkpoint, by environment
    crossings: Crossings = field(default_factory=dict)  # evaluation of the last checkpoint on rough ground
    configs: list[dict[str, Any]] = field(default_factory=list)  # config.yaml of its runs
    devices: set[str] = field(default_factory=set)  # where it was trained and evaluated
    notes: list[str] = field(default_factory=list)  # problems with its files

    @property
    def rows(self) -> list[Row]:
        """Evaluations during training in its own environment."""
        return self.rows_in.get(self.cell.environment, [])

    @property
    def steps(self) -> float:
        """Steps of training before the last evaluation."""
        return self.rows[-1]["steps"] if self.rows else 0

    @property
    def total_steps(self) -> int:
        """Steps of the whole training according to its settings, or else the paper's."""
        config = self.configs[-1] if self.configs else {}
        steps, iterations = steps_per_iteration(config), config.get("max_iterations")
        return steps * iterations if steps is not None and type(iterations) is int else PAPER_STEPS

    def is_finished(self, steps: float) -> bool:
        """Return whether fewer steps are left than lie between two evaluations."""
        interval = self.rows[-1]["steps"] - self.rows[-2]["steps"] if len(self.rows) > 1 else 1
        return steps + interval > self.total_steps

    def counted_rows(self, evaluated: str, from_step: float) -> list[Row]:
        """Return the evaluations in an environment that count for Table I, or else that of the last checkpoint."""
        rows = self.rows_in.get(evaluated, [])
        if not rows:
            return [self.results[evaluated]] if evaluated in self.results else []
        first = from_step if self.steps >= from_step else (1.0 - LAST_SHARE) * self.steps
        return [row for row in rows if row["steps"] >= first]


@dataclass
class Experiment:
    """The folder of an experiment, or of runs that nobody has planned together."""

    folder: Path
    plan: Matrix  # what was planned, or else what there is
    runs: list[CellResult]  # trainings that have begun, in the plan's order
    unplanned: list[str]  # folders of trainings that the plan does not name
    is_planned: bool = True  # whether it has an experiment.yaml
    notes: list[str] = field(default_factory=list)  # problems with files of no training

    def runs_of(self, task: str, environment: str) -> list[CellResult]:
        """Return the trainings of a task in an environment that have begun."""
        return [run for run in self.runs if (run.cell.task, run.cell.environment) == (task, environment)]

    def num_expected(self, task: str, environment: str) -> int:
        """Return how many seeds of a task an environment should have: those planned, or else those there are."""
        return len(self.plan.seeds if self.is_planned else self.runs_of(task, environment))

    def has_grounds(self) -> bool:
        """Return whether rough ground was planned, or measured without a plan."""
        return bool(self.plan.grounds) or (not self.is_planned and any(run.crossings for run in self.runs))

    def is_like_paper(self) -> bool:
        """Return whether it was planned with tasks and environments of Table I."""
        pairs = ((self.plan.tasks, PAPER_TASKS), (self.plan.environments, ENVIRONMENTS))
        return self.is_planned and all(set(ours) & set(papers) for ours, papers in pairs)

    def ranges(self) -> str:
        """Return the names of the ranges of random parameters that its trainings have."""
        configs = [run.configs[-1] for run in self.runs if run.configs]
        return self.plan.ranges or " and ".join(sorted(set(map(ranges_of, configs)))) or "unknown"

    def last_part(self) -> float:
        """Return the step at which the last :data:`LAST_SHARE` of the longest training begins, in whole millions."""
        steps = (1.0 - LAST_SHARE) * max((run.total_steps for run in self.runs), default=PAPER_STEPS)
        return round(steps, -6) or steps

    def columns(self) -> dict[str, tuple[str, str]]:
        """Return the environments of training and evaluation by column, those of Table I first."""
        pairs = [(trained, name) for trained, names in self.plan.environments.items() for name in [trained, *names]]
        columns = {column_name(*pair): pair for pair in pairs}
        first = [name for name in ENVIRONMENTS if name in columns]
        return {name: columns[name] for name in [*first, *columns]}


@dataclass
class Summary:
    """A metric of a task in an environment: one value per seed, and whether all seeds are there and finished."""

    values: list[float]
    is_final: bool = True

    @property
    def mean(self) -> float:
        """Mean over the seeds."""
        return fmean(self.values)

    @property
    def standard_error(self) -> float | None:
        """Standard error of the mean; None with one seed."""
        return stdev(self.values) / math.sqrt(len(self.values)) if len(self.values) > 1 else None


Cells = dict[str, dict[str, Summary]]  # summaries of a column by task and metric; metrics without a value are absent
Table = dict[str, Cells]  # summaries by column


def column_name(trained: str, evaluated: str) -> str:
    """Return the name of a column: the paper trains "doubled" in high_frequency, and all others in themselves."""
    if trained == evaluated != "doubled" or (trained, evaluated) == ("high_frequency", "doubled"):
        return evaluated
    return f"{trained} -> {evaluated}"


def is_of_paper(column: str) -> bool:
    """Return whether a column is one of Table I."""
    return " -> " not in column


def read_experiment(folder: Path) -> Experiment:
    """Read the folder of an experiment, or one with runs of train.py.

    UserError if there is none, its plan cannot be read, or without a plan, there is no run.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder '{folder}'")
    if not (folder / SETTINGS_FILE).is_file():
        notes: list[str] = []
        trainings = find_trainings(folder, notes)
        runs = [read_cell(cell, parts) for cell, parts in trainings.items()]
        return Experiment(folder, plan_of(trainings), runs, [], is_planned=False, notes=notes)
    plan = read_plan(folder / SETTINGS_FILE)
    cells = plan.cells(folder)
    others = {path.name for path in folder.iterdir() if path.is_dir()} - {cell.name for cell in cells}
    unplanned = sorted(name for name in others if re.fullmatch(r".+-.+-s\d+", name))
    runs = [read_cell(cell, sorted(cell.folder.glob("*/"))) for cell in cells if cell.folder.is_dir()]
    return Experiment(folder, plan, runs, unplanned)


def read_cell(cell: Cell, runs: list[Path]) -> CellResult:
    """Read the files of a training and its runs. A run's rows replace those of earlier ones from its first one on."""
    result = CellResult(cell)
    for run_dir in runs:
        if (run_dir / CONFIG_FILE).is_file():
            try:
                result.configs.append(load_config(run_dir))
                result.devices.add(str(result.configs[-1].get("device_name", result.configs[-1].get("device"))))
            except UserError as error:
                result.notes.append(str(error))
        for name in dict.fromkeys([cell.environment, *cell.evaluated_in]):
            rows = read_rows(cell.rows_file(run_dir, name), result.notes)
            if rows:
                before = [row for row in result.rows_in.get(name, []) if row["steps"] < rows[0]["steps"]]
                result.rows_in[name] = before + rows
    result.crossings = read_crossings(cell.result_file(ROUGH_GROUND), result.notes)
    for file in sorted([*cell.folder.glob("result_*.json"), *cell.folder.glob("*/result_*.json")]):
        try:
            values = json.loads(file.read_text(encoding="utf-8"))
            means = {name: estimate.get("mean") for name, estimate in values["metrics"].items()}
            row = to_row({"steps": values["steps"], **means})
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            result.notes.append(f"'{file}' cannot be read")
            continue
        result.devices.add(str(values.get("device")))
        environment = file.stem.removeprefix("result_")
        if environment not in result.results or row["steps"] >= result.results[environment]["steps"]:
            result.results[environment] = row
    result.notes = [note.replace(f"{cell.folder.parent}/", "") for note in result.notes]
    return result


def summarize(experiment: Experiment, from_step: float) -> Table:
    """Return all metrics over seeds. The value of a seed is the mean of its finite evaluations that count."""
    table: Table = {}
    for column, (trained, evaluated) in experiment.columns().items():
        for task in experiment.plan.tasks:
            counted = [(run, run.counted_rows(evaluated, from_step)) for run in experiment.runs_of(task, trained)]
            are_finished = all(run.is_finished(rows[-1]["steps"]) for run, rows in counted if rows)
            cell = table.setdefault(column, {}).setdefault(task, {})
            for name in (metric.name for metric in CURVE_METRICS):
                finite = [[row[name] for row in rows if math.isfinite(row[name])] for _, rows in counted]
                values = [fmean(numbers) for numbers in finite if numbers]
                if values:
                    cell[name] = Summary(values, are_finished and len(values) == experiment.num_expected(task, trained))
    return table


def compare(cells: Cells, metric: str, pairs: list[tuple[str, str]]) -> list[float | None]:
    """Return the corrected p value of each pair of tasks in a column of the table; these tests are one family."""
    values = {task: cell[metric].values if metric in cell else [] for task, cell in cells.items()}
    return holm([welch(values[first], values[second]) for first, second in pairs])


def welch(first: list[float], second: list[float]) -> float | None:
    """Return the two-sided p value of Welch's t-test; None with fewer than two values on a side, or no variance."""
    try:
        from scipy.stats import ttest_ind_from_stats
    except ImportError:
        raise UserError("reports need the extra: pip install 'legged_torque[plots]'") from None
    if min(len(first), len(second)) < 2 or stdev(first) == stdev(second) == 0.0:
        return None
    one, other = ((fmean(values), stdev(values), len(values)) for values in (first, second))
    return float(ttest_ind_from_stats(*one, *other, equal_var=False).pvalue)


def holm(p_values: list[float | None]) -> list[float | None]:
    """Return the p values with Holm's correction for as many tests as there are; None stays None."""
    order = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    corrected, largest = list(p_values), 0.0
    for rank, (p, i) in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p))
        corrected[i] = largest
    return corrected


def write_tables(experiment: Experiment, table: Table, out: Path) -> None:
    """Write all summaries as CSV, and every evaluation during training as compressed CSV, with four digits.

    If there is rough ground, what came out there is a third file.
    """
    names = [metric.name for metric in CURVE_METRICS]
    summaries: list[list[Any]] = [["task", "environment", "metric", "mean", "standard_error", "seeds", "paper_mean"]]
    keys = [(task, column, name) for column, cells in table.items() for task in cells for name in names]
    for task, column, name in keys:
        found = table[column][task].get(name)
        numbers = [found.mean, found.standard_error, len(found.values)] if found else [None, None, 0]
        summaries.append([task, column, name, *numbers, paper_value(task, column, name)])
    evaluations: list[list[Any]] = [["task", "environment", "seed", "steps", "seconds", *names]]
    runs = sorted(experiment.runs, key=lambda run: run.cell.name)
    for cell, evaluated, rows in ((run.cell, *entry) for run in runs for entry in run.rows_in.items()):
        column = column_name(cell.environment, evaluated)
        for row in rows:
            values = [f"{row[name]:.4g}" if math.isfinite(row[name]) else None for name in ("seconds", *names)]
            evaluations.append([cell.task, column, cell.seed, row["steps"], *values])
    if experiment.has_grounds():
        tiles: list[list[Any]] = [["task", "environment", "seed", "kind", "level", *MEASURES]]
        for cell, crossings in ((run.cell, run.crossings) for run in runs):
            tiles += [[cell.task, cell.environment, cell.seed, *tile, *crossings[tile].values()] for tile in crossings]
        (out / GROUNDS_FILE).write_bytes(csv_bytes(tiles))
    (out / TABLE_FILE).write_bytes(csv_bytes(summaries))
    (out / EVALUATIONS_FILE).write_bytes(gzip.compress(csv_bytes(evaluations), mtime=0))  # the same bytes every time


def csv_bytes(rows: list[list[Any]]) -> bytes:
    """Return rows as the bytes of a CSV file."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue().encode()
