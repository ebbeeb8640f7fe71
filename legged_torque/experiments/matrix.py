"""A matrix of trainings, tasks x environments x seeds: its description, and the progress of each of its cells."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from legged_torque import SCRIPTS_DIR
from legged_torque.envs import task_registry
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.utils.config import parse_yaml
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.options import Options
from legged_torque.utils.runs import checkpoint_numbers, load_config

SETTINGS_FILE = "experiment.yaml"
"""Copy of the description, in the folder of the results."""
CELL_SETTINGS = {"seed": "seeds", "runner.experiment_name": "tasks, environments and seeds"}
"""Settings that ``train`` must not change, and the keys that they come from."""
EVALUATION = {"num_envs": 256, "num_steps": 2000}
"""Worlds and control steps of an evaluation, unless the description has others."""


@dataclass(frozen=True)
class Cell:
    """One training and the evaluations of its last checkpoint.

    Attributes:
        task: Name of the task.
        environment: Perturbation during training.
        seed: Random seed.
        evaluated_in: Perturbations in which the last checkpoint is evaluated.
    """

    task: str
    environment: str
    seed: int
    evaluated_in: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the cell and of its folder."""
        return f"{self.task}-{self.environment}-s{self.seed}"


@dataclass(frozen=True)
class Matrix:
    """The trainings and evaluations of an experiment.

    Attributes:
        tasks: Names of tasks.
        environments: For each perturbation during training, those in which the last checkpoint is evaluated.
        seeds: Random seeds.
        ranges: Ranges of random parameters, as ``--ranges`` takes them; empty: the tasks' own.
        train: Changed settings of the trainings, by dotted path.
        evaluation: Worlds and control steps of an evaluation, as in :data:`EVALUATION`.
    """

    tasks: list[str]
    environments: dict[str, list[str]]
    seeds: list[int]
    ranges: str = ""
    train: dict[str, Any] = field(default_factory=dict)
    evaluation: dict[str, int] = field(default_factory=dict)

    def cells(self) -> list[Cell]:
        """Return all cells, seed by seed, so that tasks can be compared before all seeds are done."""
        return [
            Cell(task, environment, seed, tuple(evaluated_in))
            for seed in self.seeds
            for environment, evaluated_in in self.environments.items()
            for task in self.tasks
        ]


@dataclass(frozen=True)
class CellState:
    """The progress of a cell.

    Attributes:
        iterations: Iterations of training before its last checkpoint.
        total: Iterations of the whole training; None if it has no checkpoint.
        missing: Perturbations without a readable result.
    """

    iterations: int
    total: int | None
    missing: tuple[str, ...]

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
        evaluations = f"evaluate in {', '.join(self.missing)}"
        return {
            "": "done",
            "train": f"train, {evaluations}",
            "resume": f"resume after {self.iterations} of {self.total} iterations, {evaluations}",
            "evaluate": evaluations,
        }[self.step]


def read_matrix(file: Path) -> Matrix:
    """Read and check the description of a matrix.

    Raises:
        UserError: If it cannot be read or is not valid.
    """
    if not file.is_file():
        raise UserError(f"there is no file '{file}'")
    values = parse_yaml(file.read_text(encoding="utf-8", errors="replace"), f"'{file}'")
    keys = list(Matrix.__dataclass_fields__)
    if not isinstance(values, dict):
        raise UserError(f"'{file}' must hold the keys {', '.join(keys)}")
    for key in values:
        if key not in keys:
            raise unknown_name("experiment key", str(key), keys)
    for key in ("tasks", "environments", "seeds"):
        if key not in values:
            raise UserError(f"'{file}' lacks the key '{key}'")
    for key in ("environments", "train", "evaluation"):
        if not isinstance(values.setdefault(key, {}), dict):
            raise UserError(f"experiment key '{key}' must hold entries 'name: value', not {values[key]!r}")
    check_list("tasks", values["tasks"], str)
    check_list("seeds", values["seeds"], int)
    check_list("environments", list(values["environments"]), str)
    for name, evaluated_in in values["environments"].items():
        check_list(f"environments.{name}", evaluated_in, str)
    check_evaluation(values["evaluation"])
    values["evaluation"] = EVALUATION | values["evaluation"]
    matrix = Matrix(**values)
    check_settings(matrix)
    return matrix


def check_list(key: str, values: Any, kind: type) -> None:
    """Check that an entry is a list of one value or more, of one type and all different.

    Raises:
        UserError: Naming the key.
    """
    if not isinstance(values, list) or not values or any(type(value) is not kind for value in values):
        example = "[1, 2]" if kind is int else "[a, b]"
        raise UserError(f"experiment key '{key}' must be a list like {example}, not {values!r}")
    if len(set(values)) < len(values):
        raise UserError(f"experiment key '{key}' holds something twice: {values}")


def check_evaluation(values: dict[str, Any]) -> None:
    """Check the numbers of an evaluation.

    Raises:
        UserError: If a key is unknown or a number is not valid.
    """
    for key, value in values.items():
        if key not in EVALUATION:
            raise unknown_name("evaluation key", str(key), EVALUATION)
        if type(value) is not int or value < 1:
            raise UserError(f"evaluation.{key} must be a whole number of at least 1, not {value!r}")


def check_settings(matrix: Matrix) -> None:
    """Check what train.py and evaluate.py would check only hours later: tasks, perturbations and settings.

    Raises:
        UserError: Naming the first invalid one, with the nearest valid name.
    """
    for key, source in CELL_SETTINGS.items():
        if key in matrix.train:
            raise UserError(f"train.{key} cannot be set: it comes from {source}")
    for cell in matrix.cells():
        env_cfg = task_settings(matrix, cell)
        check_env_cfg(env_cfg)
        for name in cell.evaluated_in:
            if name not in env_cfg.perturbations():
                raise unknown_name("perturbation", name, env_cfg.perturbations())


def task_settings(matrix: Matrix, cell: Cell) -> Any:
    """Return the settings of a cell's task in a new run.

    Raises:
        UserError: If the task or one of its settings is unknown or not valid.
    """
    ranges = str(matrix.ranges) if matrix.ranges else None
    options = Options(device="cpu", seed=cell.seed, perturbation=cell.environment, ranges=ranges, set=set_words(matrix))
    return task_registry.get_cfgs(cell.task, options)[0]


def set_words(matrix: Matrix) -> list[str]:
    """Return the changed settings of the trainings as ``--set`` takes them."""
    return [f"{key}={v if isinstance(v, str) else json.dumps(v, default=str)}" for key, v in matrix.train.items()]


def step_command(matrix: Matrix, out: Path, cell: Cell, state: CellState, device: str) -> list[str]:
    """Return the command line of a cell's next step.

    Args:
        matrix: The trainings and evaluations.
        out: Folder of all results.
        cell: The cell.
        state: Its progress.
        device: Device of the step, as ``--device`` takes it.
    """
    words = [f"--task={cell.task}", f"--log_root={out}", f"--experiment_name={cell.name}", f"--device={device}"]
    if state.step == "evaluate":
        name, numbers = state.missing[0], matrix.evaluation
        words += [f"--perturbation={name}", f"--num_envs={numbers['num_envs']}", f"--steps={numbers['num_steps']}"]
        return [sys.executable, str(SCRIPTS_DIR / "evaluate.py"), *words, f"--json={part_file(out, cell, name)}"]
    if state.step == "resume":
        words.append("--resume")
    else:
        words += [f"--seed={cell.seed}", f"--perturbation={cell.environment}"]
        words += [f"--set={word}" for word in set_words(matrix)]
        words += [f"--ranges={matrix.ranges}"] if matrix.ranges else []
    return [sys.executable, str(SCRIPTS_DIR / "train.py"), *words]


def cell_state(out: Path, cell: Cell) -> CellState:
    """Return the progress of a cell.

    Raises:
        UserError: If the settings of its newest run with a checkpoint lack the number of iterations.
    """
    missing = tuple(name for name in cell.evaluated_in if not is_json(result_file(out, cell, name)))
    for run_dir in sorted((out / cell.name).glob("*/"), reverse=True):
        numbers = checkpoint_numbers(run_dir)
        if numbers:
            total = load_config(run_dir).get("max_iterations")
            if type(total) is not int:
                raise UserError(f"the settings of the run '{run_dir}' lack max_iterations")
            return CellState(numbers[-1], total, missing)
    return CellState(0, None, missing)


def result_file(out: Path, cell: Cell, environment: str) -> Path:
    """Return the file with the numbers of an evaluation."""
    return out / cell.name / f"result_{environment}.json"


def part_file(out: Path, cell: Cell, environment: str) -> Path:
    """Return the file that an evaluation writes; it becomes the result when the evaluation is complete."""
    return result_file(out, cell, environment).with_suffix(".json.part")


def is_json(file: Path) -> bool:
    """Return whether a file exists and holds a JSON object."""
    try:
        return isinstance(json.loads(file.read_text(encoding="utf-8")), dict)
    except (OSError, ValueError):
        return False


def check_same(matrix: Matrix, out: Path) -> None:
    """Check that the results of a folder were made with the same settings. A matrix may have more cells, but not fewer.

    Raises:
        UserError: Naming the first setting that differs.
    """
    file = out / SETTINGS_FILE
    if not file.is_file():
        return
    old, differs = read_matrix(file), f"'{out}' was made with other settings"
    for section in ("train", "evaluation"):
        was, now = getattr(old, section), getattr(matrix, section)
        for key in sorted(was.keys() | now.keys()):
            if was.get(key) != now.get(key):
                texts = [str(values.get(key, "not set")) for values in (now, was)]
                raise UserError(f"{differs}: {section}.{key} is {texts[0]}, was {texts[1]}; give another --out")
    for key, old_values in lists(old).items():
        lost = [str(value) for value in old_values if value not in lists(matrix).get(key, [])]
        if lost:
            raise UserError(f"{differs}: {key} had {', '.join(lost)} as well; give another --out")


def lists(matrix: Matrix) -> dict[str, list[Any]]:
    """Return the lists that make up the cells of a matrix, by their keys."""
    evaluated = {f"environments.{name}": names for name, names in matrix.environments.items()}
    return {"tasks": matrix.tasks, "environments": list(matrix.environments), "seeds": matrix.seeds, **evaluated}
