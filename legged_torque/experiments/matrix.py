"""A matrix of trainings, tasks x environments x seeds: its description, and the progress of each of its cells."""

import json
import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from legged_torque import SCRIPTS_DIR
from legged_torque.envs import task_registry
from legged_torque.envs.base.distillation_config import DISTILLATION
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.terrain.selection import named_kinds, rising_levels
from legged_torque.utils import runs
from legged_torque.utils.config import flat, to_dict
from legged_torque.utils.errors import UserError, check_names, refuse
from legged_torque.utils.limits import Count, Worlds, check_value, types_of
from legged_torque.utils.options import Options, draw_only, refuse_of_trainings, without_effect
from legged_torque.utils.plain_yaml import parse_yaml

SETTINGS_FILE = "experiment.yaml"  # copy of the description, in the folder of the results
CELL_SETTINGS: tuple[str, ...] = ("seed", "runner.experiment_name", "env.num_actions")
CELL_SETTINGS += ("evaluation.perturbation", "evaluation.also", "evaluation.at_end")
"""Settings that ``train`` must not change, since the experiment sets them."""
EVALUATION: dict[str, Any] = {"num_envs": 256, "num_steps": 2000}
"""Worlds and control steps of an evaluation, by default."""
GROUNDS: dict[str, Any] = {"kinds": ["all"], "levels": [level / 10 for level in range(10)], "num_envs": 40}
"""Tiles that are crossed after training, and robots on each of them, by default."""
NAME = r"\w[\w.-]*"  # of what names files, folders and figures
TYPES = {"num_envs": Worlds, "num_steps": Count, "kinds": list[str], "levels": list[float]}
ROUGH_GROUND, SWEEP, CONDITION = "rough ground", "sweep of ", "condition "
"""Name of the evaluation on :data:`GROUNDS`, and how others begin. Names of environments have no spaces."""


@dataclass(frozen=True)
class Cell:
    """One training with its evaluations: during training, or else of the last checkpoint."""

    folder: Path
    task: str
    environment: str  # perturbation during training
    seed: int
    evaluated_in: tuple[str, ...]  # perturbations
    further: tuple[str, ...] = ()  # of the last checkpoint: ROUGH_GROUND, sweeps, conditions

    @property
    def name(self) -> str:
        """Name of the cell and of its folder."""
        return self.folder.name

    @property
    def evaluations(self) -> list[str]:
        """Names of all evaluations."""
        return [*self.evaluated_in, *self.further]

    def result_file(self, evaluation: str) -> Path:
        """Return the file with the numbers of an evaluation of the last checkpoint."""
        for start, kind in ((SWEEP, "sweep"), (CONDITION, "condition")):
            if evaluation.startswith(start):
                return self.folder / f"{kind}_{evaluation.removeprefix(start)}.json"
        return self.folder / ("grounds.json" if evaluation == ROUGH_GROUND else f"result_{evaluation}.json")

    def part_file(self, evaluation: str) -> Path:
        """Return the file that an evaluation writes. It is renamed to the result when the evaluation is complete."""
        return self.result_file(evaluation).with_suffix(".json.part")

    def rows_file(self, run_dir: Path, environment: str) -> Path:
        """Return the file of a run's evaluations in an environment during training."""
        return runs.evaluations_file(run_dir, "" if environment == self.environment else environment)


@dataclass(frozen=True)
class Matrix:
    """The trainings and evaluations of an experiment."""

    tasks: list[str]
    environments: dict[str, list[str]]  # for each perturbation during training, those of the evaluations
    seeds: list[int]
    preset: str = ""  # of the trainings, as --preset takes it; empty: that of the device
    ranges: str = ""  # of random parameters, as --ranges takes them; empty: the tasks' own
    train: dict[str, Any] = field(default_factory=dict)  # changed settings, by dotted path
    evaluation: dict[str, Any] = field(default_factory=dict)  # as EVALUATION
    grounds: dict[str, Any] = field(default_factory=dict)  # as GROUNDS; empty: none
    sweeps: dict[str, Any] = field(default_factory=dict)  # settings of each, by the parameter that is swept
    conditions: dict[str, Any] = field(default_factory=dict)  # settings of other evaluations, by names of one's own
    task_files: tuple[str, ...] = ()  # --task_file of the command line; a description cannot name any

    def cells(self, out: Path) -> list[Cell]:
        """Return all cells in a folder, seed by seed, so that tasks can be compared before all seeds are done."""
        further = (*([ROUGH_GROUND] if self.grounds else []), *self.changed())
        return [
            Cell(out / f"{task}-{environment}-s{seed}", task, environment, seed, tuple(evaluated_in), further)
            for seed in self.seeds
            for environment, evaluated_in in self.environments.items()
            for task in self.tasks
        ]

    def changed(self) -> dict[str, dict[str, Any]]:
        """Return the changed settings of sweeps and conditions, by the names of their evaluations."""
        of_sweeps = {f"{SWEEP}{name}": settings for name, settings in self.sweeps.items()}
        return of_sweeps | {f"{CONDITION}{name}": settings for name, settings in self.conditions.items()}

    def lists(self) -> dict[str, list[Any]]:
        """Return the lists that make up the cells, by their keys."""
        evaluated = {f"environments.{name}": names for name, names in self.environments.items()}
        return {"tasks": self.tasks, "seeds": self.seeds, "environments": list(self.environments), **evaluated}

    def settings(self) -> dict[str, Any]:
        """Return what is set for all cells, by "section.key"; values stay whole."""
        named = {name: value for name in ("preset", "ranges") if (value := getattr(self, name))}
        sections = {name: getattr(self, name) for name in ("train", "evaluation", "grounds", "sweeps", "conditions")}
        return named | {f"{name}.{key}": value for name, values in sections.items() for key, value in values.items()}


KEYS = {name: hint for name, hint in types_of(Matrix).items() if name != "task_files"}
"""Keys of a description, and the types of their values."""


@dataclass(frozen=True)
class CellState:
    """The progress of a cell."""

    iterations: int  # of training before its last checkpoint
    total: int | None  # of the whole training; None if it has no checkpoint
    missing: list[str]  # evaluations without a readable result
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

    Tasks that ``task_files`` register are allowed; the files are imported.
    """
    from legged_torque.envs.base.asset import load_asset
    from legged_torque.learning.distillation import check_student

    task_registry.import_files(task_files)
    matrix = replace(read_plan(file), task_files=tuple(str(Path(name).resolve()) for name in task_files))
    for key in CELL_SETTINGS:
        if key in flat(matrix.train):
            raise UserError(f"train.{key} cannot be set: the experiment sets it")
    named_kinds(matrix.grounds.get("kinds", []))
    rising_levels(matrix.grounds.get("levels", []))
    for evaluation, settings in matrix.changed().items():
        if "env.num_envs" in flat(settings):
            raise UserError(f"env.num_envs of {evaluation} cannot be set: it is evaluation.num_envs")
    of_tasks = {}
    for cell in matrix.cells(Path()):
        words, options = set_words(matrix.train), Options(device="cpu", seed=cell.seed, perturbation=cell.environment)
        options.preset, options.ranges, options.set = matrix.preset, matrix.ranges, words
        options.task, options.experiment_name = cell.task, cell.name  # which is where teachers are sought
        env_cfg, train_cfg = task_registry.get_new_cfgs(options)
        check_env_cfg(env_cfg)
        if train_cfg.algorithm.class_name == DISTILLATION:
            learner = train_cfg.distillation
            check_student(learner.teachers, train_cfg.runner.num_steps_per_env, learner.gradient_length)
        check_names("perturbation", cell.evaluated_in, env_cfg.perturbations())
        for evaluation, settings in matrix.changed().items() if cell.task not in of_tasks else ():
            options.set, options.perturbation = [*words, *set_words(settings)], "none"  # as step_words has it
            changed = task_registry.get_new_cfgs(options)[0]
            refuse_of_trainings(flat(settings), evaluation, changed)
            changed.commands.curriculum = False  # as evaluations have it
            check_env_cfg(changed)
            if evaluation.startswith(SWEEP):
                draw_only(changed, evaluation.removeprefix(SWEEP))
            else:
                refuse([*without_effect(changed, settings)], evaluation)
            if to_dict(changed.asset) != to_dict(env_cfg.asset):
                load_asset(changed)
        of_tasks[cell.task] = env_cfg
    for env_cfg in of_tasks.values():
        load_asset(env_cfg)
    return matrix


def read_plan(file: Path) -> Matrix:
    """Read a matrix whose tasks and settings may be those of another version; UserError if it is not well formed."""
    if not file.is_file():
        raise UserError(f"there is no file '{file}'")
    values = parse_yaml(file.read_text(encoding="utf-8", errors="replace"), f"'{file}'")
    if not isinstance(values, dict) or not {"tasks", "environments", "seeds"} <= values.keys():
        raise UserError(f"'{file}' must hold the keys tasks, environments and seeds, and may hold {', '.join(KEYS)}")
    for key, value in values.items():
        check_names("experiment key", [key], KEYS)
        values[key] = check_value(key, value, KEYS[key])
    for section, defaults in {"evaluation": EVALUATION, "grounds": GROUNDS}.items():
        for key, value in values.get(section, {}).items():
            check_names(f"{section} key", [key], defaults)
            values[section][key] = check_value(f"{section}.{key}", value, TYPES[key])
            if value == []:
                raise UserError(f"{section}.{key} must hold one entry or more, not {value}")
    grounds = GROUNDS | values["grounds"] if values.get("grounds") else {}
    for section in ("sweeps", "conditions"):
        for name, settings in values.get(section, {}).items():
            if not isinstance(settings, dict):
                raise UserError(f"{section}.{name} must hold settings, not {settings!r}")
            if not re.fullmatch(NAME, str(name)):
                raise UserError(f"{section} must hold names, not {name!r}")
    matrix = Matrix(**values | {"evaluation": EVALUATION | values.get("evaluation", {}), "grounds": grounds})
    for key, entries in matrix.lists().items():
        if not entries or len(set(entries)) < len(entries):
            raise UserError(f"{key} must hold different entries, one or more, not {entries}")
        for entry in entries:
            if key != "seeds" and not re.fullmatch(NAME, str(entry)):
                raise UserError(f"{key} must hold names, not {entry!r}")
    return matrix


def check_same(matrix: Matrix, out: Path) -> None:
    """Refuse a folder with results of other settings, by UserError. A matrix may have more cells, but not fewer."""
    if not (out / SETTINGS_FILE).is_file():
        return
    old, differs = read_plan(out / SETTINGS_FILE), f"'{out}' was made with other settings"
    was, now = old.settings(), matrix.settings()
    for key in sorted(was.keys() | now.keys()):
        is_now, before = (str(each.get(key, "not set")) for each in (now, was))
        if is_now != before:
            raise UserError(f"{differs}: {key} is {is_now}, was {before}; give another --out")
    for key, values in old.lists().items():
        lost = [str(value) for value in values if value not in matrix.lists().get(key, [])]
        if lost:
            raise UserError(f"{differs}: {key} had {', '.join(lost)} as well; give another --out")


def step_words(matrix: Matrix, cell: Cell, state: CellState, device: str) -> list[str]:
    """Return the script of a cell's next step and its arguments, for a device named as ``--device`` takes it."""
    words = [f"--task={cell.task}", f"--log_root={cell.folder.parent}", f"--experiment_name={cell.name}"]
    words += [f"--device={device}", *(f"--task_file={file}" for file in matrix.task_files)]
    if state.step == "evaluate":
        name, numbers = state.missing[0], matrix.evaluation
        if name == ROUGH_GROUND:
            kinds, levels, num_envs = (matrix.grounds[key] for key in GROUNDS)
            words += [f"--num_envs={num_envs}", "--terrain", *kinds, "--level", *map(str, levels)]
        else:
            words += [f"--perturbation={name if name in cell.evaluated_in else 'none'}"]
            words += [f"--num_envs={numbers['num_envs']}", f"--steps={numbers['num_steps']}"]
            words += [f"--sweep={name.removeprefix(SWEEP)}"] if name.startswith(SWEEP) else []
            words += [f"--set={word}" for word in set_words(matrix.changed().get(name, {}))]
        return ["evaluate.py", *words, f"--json={cell.part_file(name)}"]
    if state.step == "resume":
        return ["train.py", *words, "--resume"]
    words += [f"--seed={cell.seed}", f"--perturbation={cell.environment}"]
    also = [name for name in cell.evaluated_in if name != cell.environment]
    words += [f"--set={word}" for word in [*set_words(matrix.train), f"evaluation.also={json.dumps(also)}"]]
    words.append("--set=evaluation.at_end=False")  # those are short: without others, the last checkpoint is measured
    named = {"preset": matrix.preset, "ranges": matrix.ranges}
    return ["train.py", *words, *(f"--{name}={value}" for name, value in named.items() if value)]


def set_words(changed: dict[str, Any]) -> list[str]:
    """Return changed settings as ``--set`` takes them."""
    return [f"{key}={v if isinstance(v, str) else json.dumps(v, default=str)}" for key, v in changed.items()]


def command_of(words: list[str]) -> list[str]:
    """Return the command line that runs a script, given by its name and its arguments, on this machine."""
    return [sys.executable, str(SCRIPTS_DIR / words[0]), *words[1:]]


def cell_state(cell: Cell) -> CellState:
    """Return the progress of a cell; UserError if its newest run with a checkpoint does not say how long it is."""
    missing = [name for name in cell.evaluations if not is_json(cell.result_file(name))]
    newest = last_checkpoint(cell)
    if newest is None:
        return CellState(0, None, missing)
    config, iterations = runs.load_config(newest.parent), runs.checkpoint_number(newest)
    total = config.get("max_iterations")
    if type(total) is not int:
        raise UserError(f"the settings of the run '{newest.parent}' lack max_iterations")
    if iterations >= total:  # evaluations during a complete training are results, too
        folders = list(cell.folder.glob("*/"))
        missing = [name for name in missing if not any(has_rows(cell.rows_file(run, name)) for run in folders)]
    return CellState(iterations, total, missing, iterations * (runs.steps_per_iteration(config) or 0))


def is_done(cell: Cell) -> bool:
    """Return whether nothing is left to do in a cell; False if its settings cannot be read."""
    try:
        return not cell_state(cell).missing
    except UserError:
        return False


def last_checkpoint(cell: Cell) -> Path | None:
    """Return the file of a cell's last checkpoint that is not damaged, or None; clocks of machines may differ."""
    folders = sorted(cell.folder.glob("*/"), reverse=True)
    return max(filter(None, map(runs.newest_checkpoint, folders)), key=runs.checkpoint_number, default=None)


def has_rows(file: Path) -> bool:
    """Return whether a CSV file exists and has a complete line after its header."""
    return file.is_file() and file.read_bytes().count(b"\n") > 1


def is_json(file: Path) -> bool:
    """Return whether a file exists and holds a JSON object."""
    try:
        return isinstance(json.loads(file.read_text(encoding="utf-8")), dict)
    except (OSError, ValueError, RecursionError):  # nested too deeply
        return False
