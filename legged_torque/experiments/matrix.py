"""A matrix of trainings, tasks x environments x seeds: its description, and the progress of each of its cells."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from legged_torque import SCRIPTS_DIR
from legged_torque.envs import task_registry
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.terrain.selection import named_kinds, rising_levels
from legged_torque.utils.args import task_file_words
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.limits import check_value
from legged_torque.utils.options import Options
from legged_torque.utils.plain_yaml import parse_yaml
from legged_torque.utils.runs import (
    checkpoint_number,
    evaluations_file,
    load_config,
    newest_checkpoint,
    steps_per_iteration,
)

SETTINGS_FILE = "experiment.yaml"  # copy of the description, in the folder of the results
CELL_SETTINGS = {
    "seed": "seeds",
    "runner.experiment_name": "tasks, environments and seeds",
    "env.num_actions": "the tasks",
    "evaluation.perturbation": "environments",
    "evaluation.also": "environments",
}
"""Settings that ``train`` must not change, and the keys that they come from."""
EVALUATION = {"num_envs": 256, "num_steps": 2000}
"""Worlds and control steps of an evaluation, unless the description has others."""
GROUNDS = {"kinds": ["all"], "levels": [level / 10 for level in range(10)], "num_envs": 40}
"""Which tiles are crossed after training, and by how many robots each, unless the description has others."""
GROUNDS_TYPES = {"kinds": list[str], "levels": list[float], "num_envs": int}
ROUGH_GROUND = "rough ground"
"""Stands for the evaluation on :data:`GROUNDS` where others have the name of an environment, which has no space."""


@dataclass(frozen=True)
class Cell:
    """One training, and evaluations while it trains or, in environments without them, of its last checkpoint."""

    folder: Path
    task: str
    environment: str  # perturbation during training
    seed: int
    evaluated_in: tuple[str, ...]  # perturbations
    crosses: bool = False  # whether the last checkpoint is evaluated on rough ground, too

    @property
    def name(self) -> str:
        """Name of the cell and of its folder."""
        return self.folder.name

    def result_file(self, environment: str) -> Path:
        """Return the file with the numbers of an evaluation, in an environment or on :data:`ROUGH_GROUND`."""
        return self.folder / ("grounds.json" if environment == ROUGH_GROUND else f"result_{environment}.json")

    @property
    def results(self) -> list[Path]:
        """Files with the numbers of evaluations of the last checkpoint."""
        return [self.result_file(name) for name in (*self.evaluated_in, ROUGH_GROUND)]

    def part_file(self, environment: str) -> Path:
        """Return the file that an evaluation writes; it becomes the result when the evaluation is complete."""
        return self.result_file(environment).with_suffix(".json.part")

    def rows_file(self, run_dir: Path, environment: str) -> Path:
        """Return the file of a run's evaluations in an environment while it trained."""
        return evaluations_file(run_dir, "" if environment == self.environment else environment)

    def missing(self) -> list[str]:
        """Return the perturbations with neither a readable result nor evaluations during a training that is whole.

        After them comes :data:`ROUGH_GROUND`, if its result is planned and not there.
        """
        names = [*self.evaluated_in, *([ROUGH_GROUND] if self.crosses else [])]
        missing = [name for name in names if not is_json(self.result_file(name))]
        runs = list(self.folder.glob("*/")) if missing else []
        measured = [name for name in missing if any(has_rows(self.rows_file(run, name)) for run in runs)]
        return [name for name in missing if name not in measured] if measured and is_trained(self) else missing


@dataclass(frozen=True)
class Matrix:
    """The trainings and evaluations of an experiment."""

    tasks: list[str]
    environments: dict[str, list[str]]  # for each perturbation during training, those of the evaluations
    seeds: list[int]
    ranges: str = ""  # of random parameters, as --ranges takes them; empty: the tasks' own
    train: dict[str, Any] = field(default_factory=dict)  # changed settings, by dotted path
    evaluation: dict[str, int] = field(default_factory=dict)  # as EVALUATION
    grounds: dict[str, Any] = field(default_factory=dict)  # as GROUNDS; empty: none
    task_files: tuple[str, ...] = ()  # what --task_file of the command line gives; no description can

    def cells(self, out: Path) -> list[Cell]:
        """Return all cells in a folder, seed by seed, so that tasks can be compared before all seeds are done."""
        crosses = bool(self.grounds)
        return [
            Cell(out / f"{task}-{environment}-s{seed}", task, environment, seed, tuple(evaluated_in), crosses)
            for seed in self.seeds
            for environment, evaluated_in in self.environments.items()
            for task in self.tasks
        ]

    def lists(self) -> dict[str, list[Any]]:
        """Return the lists that make up the cells, by their keys."""
        evaluated = {f"environments.{name}": names for name, names in self.environments.items()}
        return {"tasks": self.tasks, "seeds": self.seeds, "environments": list(self.environments), **evaluated}

    def set_words(self) -> list[str]:
        """Return the changed settings of the trainings as ``--set`` takes them."""
        return [f"{key}={v if isinstance(v, str) else json.dumps(v, default=str)}" for key, v in self.train.items()]


@dataclass(frozen=True)
class CellState:
    """The progress of a cell."""

    iterations: int  # of training before its last checkpoint
    total: int | None  # of the whole training; None if it has no checkpoint
    missing: list[str]  # perturbations without a readable result
    steps: int = 0  # of all worlds in these iterations; 0 if the settings of the run do not say

    @property
    def step(self) -> str:
        """The next step: "train", "resume" or "evaluate"; "" if all is done."""
        if not self.missing:
            return ""
        if self.total is None:
            return "train"
        return "resume" if self.iterations < self.total else "evaluate"

    def __str__(self) -> str:
        """Describe all that is left to do."""
        resume = f"resume after {self.iterations} of {self.total} iterations, "
        training = {"train": "train, ", "resume": resume}.get(self.step, "")
        return f"{training}evaluate in {', '.join(self.missing)}" if self.missing else "done"


def read_matrix(file: Path, task_files: Iterable[str] = ()) -> Matrix:
    """Read a matrix, and check what train.py and evaluate.py would check only hours later; UserError if it is wrong.

    Its tasks may be those that ``task_files`` register, which are imported.
    """
    from legged_torque.envs.base.asset import load_asset

    task_registry.import_files(task_files)
    matrix = replace(read_plan(file), task_files=tuple(str(Path(name).resolve()) for name in task_files))
    for key, source in CELL_SETTINGS.items():
        if key in matrix.train:
            raise UserError(f"train.{key} cannot be set: it comes from {source}")
    named_kinds(matrix.grounds.get("kinds", []))
    rising_levels(matrix.grounds.get("levels", []))
    ranges, words = str(matrix.ranges) if matrix.ranges else None, matrix.set_words()
    cells = matrix.cells(Path())
    for cell in cells:
        if cell.seed != matrix.seeds[0] and (cell.task, cell.environment) != (cells[0].task, cells[0].environment):
            continue  # no other setting depends on the seed
        options = Options(device="cpu", seed=cell.seed, perturbation=cell.environment, ranges=ranges, set=words)
        env_cfg, _ = task_registry.get_cfgs(cell.task, options)
        check_env_cfg(env_cfg)
        if cell.seed == matrix.seeds[0]:
            load_asset(env_cfg)
        for name in cell.evaluated_in:
            if name not in env_cfg.perturbations():
                raise unknown_name("perturbation", name, env_cfg.perturbations())
    return matrix


def read_plan(file: Path) -> Matrix:
    """Read a matrix whose tasks and settings may be those of another version; UserError if it is not well formed."""
    if not file.is_file():
        raise UserError(f"there is no file '{file}'")
    values = parse_yaml(file.read_text(encoding="utf-8", errors="replace"), f"'{file}'")
    keys = [entry.name for entry in fields(Matrix) if entry.name != "task_files"]  # a file names no code to run
    if not isinstance(values, dict):
        raise UserError(f"'{file}' must hold the keys {', '.join(keys)}")
    for key in values:
        if key not in keys:
            raise unknown_name("experiment key", str(key), keys)
    for key in ("tasks", "environments", "seeds"):
        if key not in values:
            raise UserError(f"'{file}' lacks the key '{key}'")
    for key in ("environments", "train", "evaluation", "grounds"):
        if not isinstance(values.setdefault(key, {}), dict):
            raise UserError(f"experiment key '{key}' must hold entries 'name: value', not {values[key]!r}")
    for key, value in values["evaluation"].items():
        if key not in EVALUATION:
            raise unknown_name("evaluation key", str(key), EVALUATION)
        if type(value) is not int or value < 1:
            raise UserError(f"evaluation.{key} must be a whole number of at least 1, not {value!r}")
    for key, value in values["grounds"].items():
        if key not in GROUNDS:
            raise unknown_name("grounds key", str(key), GROUNDS)
        new = values["grounds"][key] = check_value(f"grounds.{key}", value, GROUNDS_TYPES[key])
        if not new or (isinstance(new, int) and new < 1):
            raise UserError(f"grounds.{key} must hold something, not {value!r}")
    values["grounds"] = values["grounds"] and GROUNDS | values["grounds"]
    matrix = Matrix(**values | {"evaluation": EVALUATION | values["evaluation"]})
    for key, entries in matrix.lists().items():
        kind, example = (int, "[1, 2]") if key == "seeds" else (str, "[a, b]")
        if not isinstance(entries, list) or not entries or any(type(entry) is not kind for entry in entries):
            raise UserError(f"experiment key '{key}' must be a list like {example}, not {entries!r}")
        if len(set(entries)) < len(entries):
            raise UserError(f"experiment key '{key}' holds something twice: {entries}")
        for entry in entries:  # they name folders and figures
            if key != "seeds" and not re.fullmatch(r"\w[\w.-]*", entry):
                raise UserError(f"experiment key '{key}' must hold names, not {entry!r}")
    return matrix


def step_words(matrix: Matrix, cell: Cell, state: CellState, device: str) -> list[str]:
    """Return the script of a cell's next step and its arguments, for a device named as ``--device`` takes it."""
    words = [f"--task={cell.task}", f"--log_root={cell.folder.parent}", f"--experiment_name={cell.name}"]
    words += [f"--device={device}", *task_file_words(matrix.task_files)]
    if state.step == "evaluate":
        name, numbers = state.missing[0], matrix.evaluation
        if name == ROUGH_GROUND:
            kinds, levels, num_envs = (matrix.grounds[key] for key in GROUNDS)
            words += [f"--num_envs={num_envs}", "--terrain", *kinds, "--level", *map(str, levels)]
        else:
            words += [f"--perturbation={name}", f"--num_envs={numbers['num_envs']}", f"--steps={numbers['num_steps']}"]
        return ["evaluate.py", *words, f"--json={cell.part_file(name)}"]
    if state.step == "resume":
        words.append("--resume")
    else:
        words += [f"--seed={cell.seed}", f"--perturbation={cell.environment}"]
        also = [name for name in cell.evaluated_in if name != cell.environment]
        words += [f"--set={word}" for word in [*matrix.set_words(), f"evaluation.also={json.dumps(also)}"]]
        words += [f"--ranges={matrix.ranges}"] if matrix.ranges else []
    return ["train.py", *words]


def command_of(words: list[str]) -> list[str]:
    """Return the command line that runs a script, given by its name and its arguments, on this machine."""
    return [sys.executable, str(SCRIPTS_DIR / words[0]), *words[1:]]


def cell_state(cell: Cell) -> CellState:
    """Return the progress of a cell; UserError if its newest run with a checkpoint does not say how long it is."""
    newest = last_checkpoint(cell)
    if newest is None:
        return CellState(0, None, cell.missing())
    config, iterations = load_config(newest.parent), checkpoint_number(newest)
    total = config.get("max_iterations")
    if type(total) is not int:
        raise UserError(f"the settings of the run '{newest.parent}' lack max_iterations")
    return CellState(iterations, total, cell.missing(), iterations * (steps_per_iteration(config) or 0))


def last_checkpoint(cell: Cell) -> Path | None:
    """Return the file of a cell's last checkpoint that is not damaged, or None; clocks of machines may differ."""
    runs = sorted(cell.folder.glob("*/"), reverse=True)
    return max(filter(None, map(newest_checkpoint, runs)), key=checkpoint_number, default=None)


def is_trained(cell: Cell) -> bool:
    """Return whether the training of a cell is whole; not so if its settings cannot be read, which is told later."""
    newest = last_checkpoint(cell)
    try:
        total = load_config(newest.parent).get("max_iterations") if newest else None
    except UserError:
        return False
    return newest is not None and type(total) is int and checkpoint_number(newest) >= total


def has_rows(file: Path) -> bool:
    """Return whether a CSV file exists and has a whole line after its header."""
    return file.is_file() and file.read_bytes().count(b"\n") > 1


def is_json(file: Path) -> bool:
    """Return whether a file exists and holds a JSON object."""
    try:
        return isinstance(json.loads(file.read_text(encoding="utf-8")), dict)
    except (OSError, ValueError, RecursionError):  # nested too deeply
        return False


def check_same(matrix: Matrix, out: Path) -> None:
    """Refuse a folder with results of other settings, by UserError. A matrix may have more cells, but not fewer."""
    if not (out / SETTINGS_FILE).is_file():
        return
    old, differs = read_plan(out / SETTINGS_FILE), f"'{out}' was made with other settings"
    for section in ("train", "evaluation", "grounds"):
        was, now = getattr(old, section), getattr(matrix, section)
        for key in sorted(was.keys() | now.keys()):
            if was.get(key) != now.get(key):
                texts = f"{now.get(key, 'not set')}, was {was.get(key, 'not set')}"
                raise UserError(f"{differs}: {section}.{key} is {texts}; give another --out")
    for key, values in old.lists().items():
        lost = [str(value) for value in values if value not in matrix.lists().get(key, [])]
        if lost:
            raise UserError(f"{differs}: {key} had {', '.join(lost)} as well; give another --out")
