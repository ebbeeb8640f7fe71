"""What came out of an experiment: read its folder, sum up over seeds, compare approaches, write tables."""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, stdev, variance
from typing import Any

from legged_torque.experiments.paper_values import ENVIRONMENTS, METRICS, paper_value
from legged_torque.utils.config import parse_yaml
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import CONFIG_FILE, load_config

ALL_METRICS = (*METRICS, "height", "speed", "falls_per_minute", "critic_gradient_norm")
LAST_SHARE = 0.18
"""Which of its last evaluations count of a run that ends too early: as large a share as 90 to 110 million steps are."""
PAPER_STEPS = 110_000_000


@dataclass
class Run:
    """One training: a task, in an environment, with a seed.

    Attributes:
        rows: Evaluations during training, merged over its parts: "steps" and all metrics, nan where there is none.
        results: Evaluations of the last checkpoint in other environments, in the same form.
        configs: The ``config.yaml`` of its parts.
        devices: Where it was trained and evaluated.
        notes: What is wrong with its files.
    """

    task: str
    environment: str
    seed: int
    rows: list[dict[str, float]] = field(default_factory=list)
    results: dict[str, dict[str, float]] = field(default_factory=dict)
    configs: list[dict[str, Any]] = field(default_factory=list)
    devices: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)

    @property
    def steps(self) -> float:
        """Steps after which the last evaluation was."""
        return self.rows[-1]["steps"] if self.rows else 0

    @property
    def total_steps(self) -> int:
        """Steps of the whole training, as its settings say; the paper's if they do not."""
        try:
            config = self.configs[-1]
            rollout = config["env"]["env"]["num_envs"] * config["train"]["runner"]["num_steps_per_env"]
            return config["max_iterations"] * rollout * config.get("processes", 1)
        except (IndexError, KeyError, TypeError):
            return PAPER_STEPS

    def is_finished(self, steps: float) -> bool:
        """Return whether so many steps are all of them, but for less than an interval between evaluations."""
        interval = self.rows[-1]["steps"] - self.rows[-2]["steps"] if len(self.rows) > 1 else 1
        return steps + interval > self.total_steps

    def counted_rows(self, evaluated: str, from_step: float) -> list[dict[str, float]]:
        """Return the evaluations in an environment that count for Table I."""
        if evaluated != self.environment:
            return [self.results[evaluated]] if evaluated in self.results else []
        first = from_step if self.steps >= from_step else (1.0 - LAST_SHARE) * self.steps
        return [row for row in self.rows if row["steps"] >= first]


@dataclass
class Experiment:
    """An experiment as it was planned, and its runs.

    Attributes:
        environments: Environments of evaluation for each one of training.
        plan: Text of ``experiment.yaml``.
        runs: By task, environment of training and seed.
        unplanned: Folders of runs that the plan does not name.
    """

    folder: Path
    tasks: list[str]
    environments: dict[str, list[str]]
    seeds: list[int]
    plan: str
    runs: dict[tuple[str, str, int], Run] = field(default_factory=dict)
    unplanned: list[str] = field(default_factory=list)

    def runs_of(self, task: str, environment: str) -> list[Run]:
        """Return the runs of a task in an environment of training that have begun."""
        keys = [(task, environment, seed) for seed in self.seeds]
        return [self.runs[key] for key in keys if key in self.runs]

    def columns(self) -> dict[str, tuple[str, str]]:
        """Return the environments of training and of evaluation by the name of their column, Table I's first."""
        pairs = [(trained, name) for trained, names in self.environments.items() for name in [trained, *names]]
        columns = {column_name(*pair): pair for pair in pairs}
        first = [name for name in ENVIRONMENTS if name in columns]
        return {name: columns[name] for name in [*first, *columns]}


@dataclass
class Summary:
    """A metric of a task in an environment: a value for each seed, and whether none is missing or unfinished."""

    values: list[float]
    is_final: bool = True

    @property
    def standard_error(self) -> float | None:
        """Standard error of the mean; None with one seed."""
        return stdev(self.values) / math.sqrt(len(self.values)) if len(self.values) > 1 else None


Table = dict[str, dict[str, dict[str, Summary]]]
"""Summaries by column, task and metric; what has no value is not in it."""


def column_name(trained: str, evaluated: str) -> str:
    """Return the name of a column: the paper's "doubled" is trained in high_frequency, all others where they are."""
    if trained == evaluated != "doubled" or (trained, evaluated) == ("high_frequency", "doubled"):
        return evaluated
    return f"{trained} -> {evaluated}"


def read_experiment(folder: Path) -> Experiment:
    """Read an experiment's folder.

    Raises:
        UserError: If there is none, or its plan cannot be read.
    """
    file = folder / "experiment.yaml"
    if not folder.is_dir():
        raise UserError(f"there is no folder '{folder}'")
    if not file.is_file():
        raise UserError(f"'{folder}' is not the folder of an experiment: it has no experiment.yaml")
    text = file.read_text(encoding="utf-8", errors="replace")
    plan = parse_yaml(text, f"'{file}'")
    kinds = {"tasks": list, "environments": dict, "seeds": list}
    if not isinstance(plan, dict) or not all(isinstance(plan.get(key), kind) for key, kind in kinds.items()):
        raise UserError(f"'{file}' lacks the lists tasks and seeds, or environments as a mapping to lists")
    environments = {name: list(evaluated or []) for name, evaluated in plan["environments"].items()}
    experiment = Experiment(folder, plan["tasks"], environments, plan["seeds"], text)
    for path in sorted(path for path in folder.iterdir() if path.is_dir()):
        match = re.fullmatch(r"(.+)-(.+)-s(\d+)", path.name)
        if not match:
            continue
        task, environment, seed = match[1], match[2], int(match[3])
        if task in plan["tasks"] and environment in environments and seed in plan["seeds"]:
            experiment.runs[task, environment, seed] = read_run(path, Run(task, environment, seed))
        else:
            experiment.unplanned.append(path.name)
    return experiment


def read_run(folder: Path, run: Run) -> Run:
    """Fill a run with what its folder holds; a part replaces what earlier ones did from its first evaluation on."""
    for part in sorted(path for path in folder.iterdir() if path.is_dir()):
        if (part / CONFIG_FILE).is_file():
            try:
                run.configs.append(load_config(part))
                run.devices.add(str(run.configs[-1].get("device")))
            except UserError as error:
                run.notes.append(str(error))
        rows = read_rows(part / "evaluations.csv", run.notes)
        if rows:
            run.rows = [row for row in run.rows if row["steps"] < rows[0]["steps"]] + rows
    for file in sorted([*folder.glob("result_*.json"), *folder.glob("*/result_*.json")]):
        environment = file.stem.removeprefix("result_")
        try:
            result = json.loads(file.read_text(encoding="utf-8"))
            values = {name: _number(result["metrics"].get(name, {}).get("mean")) for name in ALL_METRICS}
            values["steps"] = int(result["steps"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            run.notes.append(f"'{file}' cannot be read")
            continue
        run.devices.add(str(result.get("device")))
        if environment not in run.results or values["steps"] >= run.results[environment]["steps"]:
            run.results[environment] = values
    return run


def read_rows(file: Path, notes: list[str]) -> list[dict[str, float]]:
    """Read the evaluations of a part. A last line without an end was cut off by a kill and is left out."""
    if not file.is_file():
        return []
    lines = file.read_text(encoding="utf-8", errors="replace").rpartition("\n")[0].splitlines()
    rows = []
    for number, line in enumerate(csv.DictReader(lines), start=2):
        try:
            if None in line or None in line.values():
                raise ValueError("too many or too few cells")
            values = {name: _number(line.get(name)) for name in ALL_METRICS}
            rows.append({"steps": int(float(line["steps"])), **values})
        except (KeyError, ValueError):
            notes.append(f"line {number} of '{file}' cannot be read")
    return rows


def _number(cell: Any) -> float:
    """Return a cell's number; nan if it is empty."""
    return math.nan if cell in (None, "") else float(cell)


def summarize(experiment: Experiment, from_step: float) -> Table:
    """Return all metrics over seeds. A run's value is the mean of its evaluations that count and are finite."""
    table: Table = {}
    for column, (trained, evaluated) in experiment.columns().items():
        for task in experiment.tasks:
            runs = experiment.runs_of(task, trained)
            counted = [(run, run.counted_rows(evaluated, from_step)) for run in runs]
            are_finished = [run.is_finished(rows[-1]["steps"]) for run, rows in counted if rows]
            cell = table.setdefault(column, {}).setdefault(task, {})
            for metric in ALL_METRICS:
                finite = [[row[metric] for row in rows if math.isfinite(row[metric])] for _, rows in counted]
                values = [fmean(numbers) for numbers in finite if numbers]
                if values:
                    is_final = all(are_finished) and len(values) == len(experiment.seeds)
                    cell[metric] = Summary(values, is_final)
    return table


def welch(first: list[float], second: list[float]) -> float | None:
    """Return the two-sided p value of Welch's t-test; None if it cannot be told, with fewer than two values each."""
    if min(len(first), len(second)) < 2:
        return None
    shares = [variance(values) / len(values) for values in (first, second)]
    if sum(shares) == 0.0:
        return None
    t_squared = (fmean(first) - fmean(second)) ** 2 / sum(shares)
    freedom = sum(shares) ** 2 / sum(s**2 / (len(v) - 1) for s, v in zip(shares, (first, second), strict=True))
    return incomplete_beta(freedom / 2.0, 0.5, freedom / (freedom + t_squared))


def incomplete_beta(a: float, b: float, x: float) -> float:
    """Return the regularized incomplete beta function: the tail of Student's t for b = 1/2."""
    if x > 0.5:
        return 1.0 - incomplete_beta(b, a, 1.0 - x)
    if x == 0.0:
        return 0.0
    log_beta = math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
    term = math.exp(a * math.log(x) + b * math.log1p(-x) - log_beta) / a
    total, k = 0.0, 0
    while term > 1e-16 * total:  # all terms are positive, and at last each is less than 0.6 of the one before
        total += term
        term *= x * (a + b + k) / (a + 1.0 + k)
        k += 1
    return total


def holm(p_values: list[float | None]) -> list[float | None]:
    """Return the p values with Holm's correction for as many tests as there are; None stays None."""
    order = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    corrected, largest = list(p_values), 0.0
    for rank, (p, i) in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p))
        corrected[i] = largest
    return corrected


def compare(cells: dict[str, dict[str, Summary]], metric: str, pairs: list[tuple[str, str]]) -> list[float | None]:
    """Return the corrected p value of each pair of tasks in a column of the table; these tests are one family."""
    values = {task: cell[metric].values if metric in cell else [] for task, cell in cells.items()}
    return holm([welch(values[first], values[second]) for first, second in pairs])


def write_tables(experiment: Experiment, table: Table, out: Path) -> None:
    """Write ``table.csv`` (summaries) and ``evaluations.csv`` (every evaluation during training)."""
    with (out / "table.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["task", "environment", "metric", "mean", "standard_error", "seeds", "paper_mean", "paper_error"])
        for column, cells in table.items():
            for task, metric in ((task, metric) for task in cells for metric in ALL_METRICS):
                summary = cells[task].get(metric)
                numbers = (
                    [fmean(summary.values), summary.standard_error, len(summary.values)] if summary else ["", "", 0]
                )
                writer.writerow([task, column, metric, *numbers, paper_value(task, column, metric), ""])
    with (out / "evaluations.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["task", "environment", "seed", "steps", *ALL_METRICS])
        for (task, environment, seed), run in experiment.runs.items():
            for row in run.rows:
                values = [row[name] if math.isfinite(row[name]) else None for name in ALL_METRICS]
                writer.writerow([task, environment, seed, row["steps"], *values])
