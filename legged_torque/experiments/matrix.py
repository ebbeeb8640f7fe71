"""A matrix of trainings, approaches x environments x seeds: its description, and how far each of its cells is."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from legged_torque import SCRIPTS_DIR
from legged_torque.envs import task_registry
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.utils.args import Parser, add_task_args, add_train_args, options_of
from legged_torque.utils.config import parse_yaml
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.runs import checkpoint_numbers, load_config

SETTINGS_FILE = "experiment.yaml"
"""Copy of the description that a folder of results was made with."""
OF_A_CELL = {"seed": "seeds", "runner.experiment_name": "tasks, environments and seeds"}
"""Settings of a training that ``train`` must not change, because the cell says them, and where they come from."""


@dataclass(frozen=True)
class Cell:
    """One training and the evaluations of its end result.

    Attributes:
        task: Name of the task.
        environment: Perturbation in which it is trained.
        seed: Its random seed.
        evaluated_in: Perturbations in which its end result is evaluated.
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
    """What is trained and evaluated.

    Attributes:
        tasks: Names of tasks.
        environments: For each perturbation of a training those in which its end result is evaluated.
        seeds: Random seeds.
        ranges: How far random parameters go, as ``--ranges`` takes it; empty: as the tasks have it.
        train: Changed settings of the trainings, by dotted path.
        evaluation: "num_envs" worlds and "num_steps" control steps of an evaluation.
    """

    tasks: list[str]
    environments: dict[str, list[str]]
    seeds: list[int]
    ranges: str = ""
    train: dict[str, Any] = field(default_factory=dict)
    evaluation: dict[str, int] = field(default_factory=dict)

    def cells(self) -> list[Cell]:
        """Return all cells; a seed's come before the next one's, so that half a matrix can be compared already."""
        return [
            Cell(task, environment, seed, tuple(evaluated_in))
            for seed in self.seeds
            for environment, evaluated_in in self.environments.items()
            for task in self.tasks
        ]


@dataclass(frozen=True)
class State:
    """How far a cell is.

    Attributes:
        iterations: Those of its last checkpoint.
        total: Those after which its training is complete; None if it has no checkpoint.
        missing: Perturbations without a readable result.
    """

    iterations: int
    total: int | None
    missing: tuple[str, ...]

    @property
    def step(self) -> str:
        """What is to be done next: "train", "resume" or "evaluate"; "" if all is done."""
        if not self.missing:
            return ""
        if self.total is None:
            return "train"
        return "resume" if self.iterations < self.total else "evaluate"

    def __str__(self) -> str:
        """Say what is to be done, all of it."""
        evaluations = f"evaluate in {', '.join(self.missing)}"
        return {
            "": "done",
            "train": f"train, {evaluations}",
            "resume": f"resume after {self.iterations} of {self.total} iterations, {evaluations}",
            "evaluate": evaluations,
        }[self.step]


def read_matrix(file: Path) -> Matrix:
    """Return what a file describes, completely checked.

    Raises:
        UserError: If it cannot be read, or something in it is unknown or makes no sense.
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
    values["evaluation"] = {"num_envs": 256, "num_steps": 2000} | check_evaluation(values["evaluation"])
    matrix = Matrix(**values)
    check_settings(matrix)
    return matrix


def check_list(key: str, values: Any, kind: type) -> None:
    """Refuse what is not a list of different values of a type, or is empty.

    Raises:
        UserError: Naming the key.
    """
    if not isinstance(values, list) or not values or any(type(value) is not kind for value in values):
        example = "[1, 2]" if kind is int else "[a, b]"
        raise UserError(f"experiment key '{key}' must be a list like {example}, not {values!r}")
    if len(set(values)) < len(values):
        raise UserError(f"experiment key '{key}' holds something twice: {values}")


def check_evaluation(values: dict[str, Any]) -> dict[str, Any]:
    """Return the numbers of an evaluation after checking them.

    Raises:
        UserError: If a key is unknown or a number is not one.
    """
    allowed = ("num_envs", "num_steps")
    for key, value in values.items():
        if key not in allowed:
            raise unknown_name("evaluation key", str(key), allowed)
        if type(value) is not int or value < 1:
            raise UserError(f"evaluation.{key} must be a whole number of at least 1, not {value!r}")
    return values


def check_settings(matrix: Matrix) -> None:
    """Refuse tasks, perturbations and settings that train.py or evaluate.py would refuse hours later.

    Raises:
        UserError: Naming the first one, with the nearest valid name.
    """
    for key, source in OF_A_CELL.items():
        if key in matrix.train:
            raise UserError(f"train.{key} cannot be set: it comes from {source}")
    parser = Parser("settings of a training")
    add_task_args(parser)
    add_train_args(parser)
    for cell in matrix.cells():
        words = ["--device=cpu", f"--task={cell.task}", *new_run_words(matrix, cell)]
        env_cfg, _ = task_registry.get_cfgs(cell.task, options_of(parser.parse_args(words)))
        check_env_cfg(env_cfg)
        for name in cell.evaluated_in:
            if name not in env_cfg.perturbations():
                raise unknown_name("perturbation", name, env_cfg.perturbations())


def new_run_words(matrix: Matrix, cell: Cell) -> list[str]:
    """Return the options of train.py that a new run has and a resumed one keeps."""
    texts = {
        key: value if isinstance(value, str) else json.dumps(value, default=str) for key, value in matrix.train.items()
    }
    settings = [f"--set={key}={text}" for key, text in texts.items()]
    settings += [f"--ranges={matrix.ranges}"] if matrix.ranges else []
    return [f"--seed={cell.seed}", f"--perturbation={cell.environment}", *settings]


def step_command(matrix: Matrix, out: Path, cell: Cell, state: State, device: str) -> list[str]:
    """Return the command line of a cell's next step.

    Args:
        matrix: What is trained and evaluated.
        out: Folder of all results.
        cell: The cell.
        state: How far it is.
        device: Device of the step, as ``--device`` takes it.
    """
    words = [f"--task={cell.task}", f"--log_root={out}", f"--experiment_name={cell.name}", f"--device={device}"]
    if state.step == "evaluate":
        name, numbers = state.missing[0], matrix.evaluation
        words += [f"--perturbation={name}", f"--num_envs={numbers['num_envs']}", f"--steps={numbers['num_steps']}"]
        return [sys.executable, str(SCRIPTS_DIR / "evaluate.py"), *words, f"--json={part_file(out, cell, name)}"]
    words += ["--resume"] if state.step == "resume" else new_run_words(matrix, cell)
    return [sys.executable, str(SCRIPTS_DIR / "train.py"), *words]


def cell_state(out: Path, cell: Cell) -> State:
    """Return how far a cell is.

    Raises:
        UserError: If its newest run with a checkpoint does not say how many iterations it should have.
    """
    missing = tuple(name for name in cell.evaluated_in if not is_json(result_file(out, cell, name)))
    for run_dir in sorted((out / cell.name).glob("*/"), reverse=True):
        numbers = checkpoint_numbers(run_dir)
        if numbers:
            total = load_config(run_dir).get("max_iterations")
            if type(total) is not int:
                raise UserError(f"the settings of the run '{run_dir}' lack max_iterations")
            return State(numbers[-1], total, missing)
    return State(0, None, missing)


def result_file(out: Path, cell: Cell, environment: str) -> Path:
    """Return the file with the numbers of an evaluation."""
    return out / cell.name / f"result_{environment}.json"


def part_file(out: Path, cell: Cell, environment: str) -> Path:
    """Return the file that an evaluation writes, which becomes the result when it is complete."""
    return out / cell.name / f"result_{environment}.json.part"


def is_json(file: Path) -> bool:
    """Return whether a file is there and holds a JSON object."""
    try:
        return isinstance(json.loads(file.read_text(encoding="utf-8")), dict)
    except (OSError, ValueError):
        return False


def check_same(matrix: Matrix, out: Path) -> None:
    """Refuse to mix results: those of a folder must be of the same settings. More cells are fine, fewer are not.

    Raises:
        UserError: Naming the first setting that differs from those that the folder was made with.
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
    lists = {"tasks": (old.tasks, matrix.tasks), "environments": (old.environments, matrix.environments)}
    lists["seeds"] = (old.seeds, matrix.seeds)
    lists |= {f"environments.{key}": (old.environments[key], matrix.environments.get(key)) for key in old.environments}
    for key, (was, now) in lists.items():
        lost = [str(value) for value in was if value not in now]
        if lost:
            raise UserError(f"{differs}: {key} had {', '.join(lost)} as well; give another --out")
