"""The results of an experiment: everything that its folder, or a folder with runs of train.py, holds."""

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from legged_torque.experiments.matrix import CONDITION, ROUGH_GROUND, SETTINGS_FILE, SWEEP, Cell, Matrix, read_plan
from legged_torque.paper.report.evaluations import COLUMNS, METRIC_NAMES, MILLION, read_evaluations
from legged_torque.paper.report.unplanned import find_trainings, plan_of, ranges_of
from legged_torque.paper.values import ENVIRONMENTS, PAPER_TASKS
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import CONFIG_FILE, load_config, steps_per_iteration

LAST_SHARE = 0.18
"""Fraction of final evaluations averaged for unfinished runs: that of steps 90 to 110 million in a whole one."""
PAPER_STEPS = 110_000_000
MEASURES = {
    "crossed": "Share of robots that crossed their tile in time",
    "fell": "Share of robots that fell",
    "track_percentage": "Tracking",
    "cost_of_transport": "Cost of transport",
}
"""Numbers of robots on rough ground, with their meaning."""


@dataclass
class Training:
    """The results of a training that has begun."""

    cell: Cell
    evaluations: dict[str, pd.DataFrame] = field(default_factory=dict)  # while it trained, by environment
    results: dict[str, pd.DataFrame] = field(default_factory=dict)  # one row: last checkpoint, by environment
    crossings: pd.DataFrame | None = None  # kind, level, MEASURES: last checkpoint, a row per tile of rough ground
    conditions: dict[str, float] = field(default_factory=dict)  # tracking of the last checkpoint, by condition
    sweeps: dict[str, pd.DataFrame] = field(default_factory=dict)  # of the last checkpoint: as read_sweep, by parameter
    configs: list[dict[str, Any]] = field(default_factory=list)  # config.yaml of its runs
    devices: set[str] = field(default_factory=set)  # that trained and evaluated it
    problems: list[str] = field(default_factory=list)  # of its files

    @property
    def rows(self) -> pd.DataFrame:
        """Evaluations during training in its own environment."""
        return self.evaluations.get(self.cell.environment, pd.DataFrame(columns=COLUMNS))

    @property
    def steps(self) -> int:
        """Steps of training before the last evaluation."""
        return int(self.rows["steps"].iloc[-1]) if len(self.rows) else 0

    @property
    def total_steps(self) -> int:
        """Steps of the whole training according to its settings; the paper's if they do not say."""
        config = self.configs[-1] if self.configs else {}
        steps, iterations = steps_per_iteration(config), config.get("max_iterations")
        return steps * iterations if steps is not None and type(iterations) is int else PAPER_STEPS

    def measured(self) -> set[str]:
        """Return the names of the further evaluations of the last checkpoint that there are."""
        names = {SWEEP + name for name in self.sweeps} | {CONDITION + name for name in self.conditions}
        return names | (set() if self.crossings is None else {ROUGH_GROUND})

    def is_finished(self, steps: float) -> bool:
        """Return whether fewer steps are left than lie between two evaluations."""
        interval = self.rows["steps"].diff().iloc[-1] if len(self.rows) > 1 else 1
        return bool(steps + interval > self.total_steps)

    def counted(self, environment: str, from_step: float) -> pd.DataFrame:
        """Return the evaluations in an environment that count: those of the last part, or of the last checkpoint."""
        rows = self.evaluations.get(environment)
        if rows is None:
            return self.results.get(environment, pd.DataFrame(columns=COLUMNS))
        first = from_step if self.steps >= from_step else (1.0 - LAST_SHARE) * self.steps
        return rows[rows["steps"] >= first]


@dataclass
class Experiment:
    """The folder of an experiment, or of runs that were not planned together."""

    folder: Path
    plan: Matrix  # what was planned; without a plan, what there is
    runs: list[Training]  # in the plan's order
    unplanned: list[str]  # folders of trainings that are not in the plan
    is_planned: bool = True  # whether it has an experiment.yaml
    problems: list[str] = field(default_factory=list)  # of files that belong to no training

    def runs_of(self, task: str, environment: str) -> list[Training]:
        """Return the trainings of a task in an environment that have begun."""
        return [run for run in self.runs if (run.cell.task, run.cell.environment) == (task, environment)]

    def num_expected(self, task: str, environment: str) -> int:
        """Return how many seeds of a task an environment should have: those planned, or else those there are."""
        return len(self.plan.seeds if self.is_planned else self.runs_of(task, environment))

    def has_rough_ground(self) -> bool:
        """Return whether rough ground was planned, or measured without a plan."""
        return bool(self.plan.grounds) or (not self.is_planned and any(run.crossings is not None for run in self.runs))

    def crossings(self) -> pd.DataFrame:
        """Return the results on rough ground, a row per training and tile."""
        parts = [(run.cell, run.cell.environment, run.crossings) for run in self.runs if run.crossings is not None]
        return _joined(parts, ["kind", "level", *MEASURES])

    def evaluations(self) -> pd.DataFrame:
        """Return all evaluations during training, a row per training, environment and evaluation."""
        parts = [(run.cell, *part) for run in self.runs for part in run.evaluations.items()]
        parts = [(cell, column_name(cell.environment, name), rows) for cell, name, rows in parts]
        return _joined(parts, ["steps", "seconds", *METRIC_NAMES])

    def is_like_paper(self) -> bool:
        """Return whether it was planned with tasks and environments of Table I."""
        pairs = ((self.plan.tasks, PAPER_TASKS), (self.plan.environments, ENVIRONMENTS))
        return self.is_planned and all(set(ours) & set(papers) for ours, papers in pairs)

    def ranges(self) -> str:
        """Return the names of the ranges of random parameters that its trainings have."""
        configs = [run.configs[-1] for run in self.runs if run.configs]
        return self.plan.ranges or " and ".join(sorted(set(map(ranges_of, configs)))) or "unknown"

    def last_part(self) -> float:
        """Return where the last :data:`LAST_SHARE` of the longest training begins [steps], in millions from ten on."""
        steps = (1.0 - LAST_SHARE) * max((run.total_steps for run in self.runs), default=PAPER_STEPS)
        return round(steps, -6) if steps >= 1e7 else steps

    def columns(self) -> dict[str, tuple[str, str]]:
        """Return the environments of training and evaluation by column of tables, those of Table I first."""
        pairs = [(trained, name) for trained, names in self.plan.environments.items() for name in [trained, *names]]
        columns = {column_name(*pair): pair for pair in pairs}
        first = [name for name in ENVIRONMENTS if name in columns]
        return {name: columns[name] for name in [*first, *columns]}


def _joined(parts: list[tuple[Cell, str, pd.DataFrame]], columns: list[str]) -> pd.DataFrame:
    """Return tables of trainings, each with the name of an environment, as one in the order of their folders' names."""
    parts = sorted(parts, key=lambda part: part[0].name)
    tables = [rows.assign(task=cell.task, environment=name, seed=cell.seed) for cell, name, rows in parts]
    columns = ["task", "environment", "seed", *columns]
    return pd.concat(tables)[columns] if tables else pd.DataFrame(columns=columns)


def column_name(trained: str, evaluated: str) -> str:
    """Return the name of a column: the paper trains "doubled" in high_frequency, and all others in themselves."""
    if trained == evaluated != "doubled" or (trained, evaluated) == ("high_frequency", "doubled"):
        return evaluated
    return f"{trained} -> {evaluated}"


def is_of_paper(column: str) -> bool:
    """Return whether a column is like those of Table I: policies are evaluated where they were trained, or doubled."""
    return " -> " not in column


def read_experiment(folder: Path) -> Experiment:
    """Read the folder of an experiment, or one with runs of train.py.

    Raises:
        UserError: If the folder or its plan cannot be read, or it has neither a plan nor a run.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder '{folder}'; experiment.py or train.py makes it")
    if not (folder / SETTINGS_FILE).is_file():
        problems: list[str] = []
        trainings = find_trainings(folder, problems)
        runs = [read_training(cell, parts) for cell, parts in trainings.items()]
        return Experiment(folder, plan_of(trainings), runs, [], is_planned=False, problems=problems)
    plan = read_plan(folder / SETTINGS_FILE)
    cells = plan.cells(folder)
    others = {path.name for path in folder.iterdir() if path.is_dir()} - {cell.name for cell in cells}
    unplanned = sorted(name for name in others if re.fullmatch(r".+-.+-s\d+", name))
    runs = [read_training(cell, sorted(cell.folder.glob("*/"))) for cell in cells if cell.folder.is_dir()]
    return Experiment(folder, plan, runs, unplanned)


def read_training(cell: Cell, runs: list[Path]) -> Training:
    """Read a training and its runs. Evaluations of a run replace those of earlier ones from its first one on."""
    training, earlier = Training(cell), ""
    for run_dir in runs:
        if (run_dir / CONFIG_FILE).is_file():
            try:
                config = load_config(run_dir)
                training.configs.append(config)
                training.devices.add(str(config.get("device_name", config.get("device"))))
            except UserError as error:
                training.problems.append(str(error))
        for name in dict.fromkeys([cell.environment, *cell.evaluated_in]):
            rows = read_evaluations(cell.rows_file(run_dir, name), training.problems)
            if len(rows):
                before = training.evaluations.get(name, rows[:0])
                kept = before[before["steps"] < rows["steps"].iloc[0]]
                training.evaluations[name] = pd.concat([kept, rows], ignore_index=True)
                if name == cell.environment:
                    most, end = before["steps"].max() / MILLION, rows["steps"].iloc[-1] / MILLION
                    if most > end:
                        later = f"the later '{run_dir.name}', which ends after {end:.4g} million, counts"
                        training.problems.append(f"'{earlier}' has {most:.4g} million steps, but {later}")
                    earlier = run_dir.name
    files = [*cell.folder.glob("result_*.json"), *cell.folder.glob("*/result_*.json")]
    files += {cell.result_file(name) for name in (ROUGH_GROUND, *cell.further)}
    for file in sorted(file for file in files if file.is_file()):
        try:
            read_result(training, file)
        except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError):
            training.problems.append(f"'{file}' cannot be read")
    training.problems = [problem.replace(f"{cell.folder.parent}/", "") for problem in training.problems]
    return training


def read_result(training: Training, file: Path) -> None:
    """Add an evaluation of the last checkpoint, in an environment or on rough ground, to a training."""
    values = json.loads(file.read_text(encoding="utf-8"))
    if file == training.cell.result_file(ROUGH_GROUND):
        tiles = pd.DataFrame(values["grounds"])
        for name in MEASURES:
            estimates = tiles[name] if name in tiles else tiles["metrics"].str[name]
            tiles[name] = [estimate["mean"] for estimate in estimates]
        training.crossings = tiles.astype({"kind": str, "level": float, **dict.fromkeys(MEASURES, float)})
        return
    training.devices.add(str(values.get("device")))
    if "sweep" in values:
        training.sweeps[values["sweep"]["parameter"]] = read_sweep(values["sweep"])
        return
    means = {name: estimate.get("mean") for name, estimate in values["metrics"].items()}
    if file.stem.startswith("condition_"):
        training.conditions[file.stem.removeprefix("condition_")] = float(np.asarray(means["track_percentage"], float))
        return
    row = pd.DataFrame([{"steps": int(values["steps"]), **means}]).reindex(columns=COLUMNS).astype(float)
    environment = file.stem.removeprefix("result_")
    before = training.results.get(environment)
    if before is None or row["steps"].iloc[0] >= before["steps"].iloc[0]:
        training.results[environment] = row.replace([np.inf, -np.inf], np.nan)


def read_sweep(sweep: dict[str, Any]) -> pd.DataFrame:
    """Return the parts of a sweep.

    Returns:
        ``at``: the middle of the part, or a delay, which is a whole number; ``value``: tracking or, if ``is_push``, the
        share of robots that fell after a push; ``standard_error`` over worlds, if it is there; ``unit`` of ``at``.
    """
    parts, is_delay = sweep["parts"], sweep["parameter"].endswith("_delay")
    at = [part["from"] if is_delay else (part["from"] + part["to"]) / 2.0 for part in parts]
    values = [part["fell"] if "fell" in part else part["metrics"]["track_percentage"] for part in parts]
    means, errors = [value["mean"] for value in values], [value.get("standard_error") for value in values]
    table = pd.DataFrame({"at": at, "value": means, "standard_error": errors}, dtype=float)
    return table.assign(unit=sweep["unit"], is_push="fell" in parts[0])
