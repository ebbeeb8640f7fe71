"""Trainings that ``train.py`` has made without a plan: which are in a folder, and with what they were made."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.experiments.matrix import SETTINGS_FILE, Cell, Matrix
from legged_torque.utils.config import flat
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import Options
from legged_torque.utils.runs import CONFIG_FILE, load_config

OWN = "own"
"""Name of random events or ranges that have none of the published names."""

Trainings = dict[Cell, list[Path]]
"""Folders of runs by training: the first one and those that have continued it, in the order of their names."""


def find_trainings(folder: Path, notes: list[str]) -> Trainings:
    """Return the trainings in a folder; each run that cannot be read adds a note. UserError if there is none.

    Runs of the same task, run name, random events and seed are one training that was interrupted and resumed; of two
    that both began at 0, the later one counts.
    """
    found: dict[tuple[str, str, int], list[Path]] = {}
    also: dict[tuple[str, str, int], tuple[str, ...]] = {}
    for run in sorted({file.parent for file in folder.rglob(CONFIG_FILE)}, key=lambda path: path.name):
        try:
            config = load_config(run)
            train = config["train"]
            task = " ".join(filter(None, [str(config["task"]), str(train["runner"].get("run_name") or "")]))
            key = (task, environment_of(config), int(train["seed"]))
            also[key] = tuple(map(str, train.get("evaluation", {}).get("also") or ()))
        except (UserError, LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            notes.append(f"the run '{run.relative_to(folder)}' cannot be read: {error}")
            continue
        found.setdefault(key, []).append(run)
    if not found:
        raise UserError(f"there is neither a file '{folder / SETTINGS_FILE}' nor a run with its {CONFIG_FILE}")
    return {Cell(found[key][-1], *key, tuple(dict.fromkeys([key[1], *also[key]]))): found[key] for key in sorted(found)}


def plan_of(trainings: Trainings) -> Matrix:
    """Return the tasks, environments and seeds of trainings, as if they had been planned."""
    environments: dict[str, list[str]] = {}
    for cell in trainings:
        names = environments.setdefault(cell.environment, [])
        names += [name for name in cell.evaluated_in if name not in names]
    tasks = list(dict.fromkeys(cell.task for cell in trainings))
    return Matrix(tasks, environments, sorted({cell.seed for cell in trainings}))


def environment_of(config: Mapping[str, Any]) -> str:
    """Return the name of the random events that a run was trained with, or :data:`OWN`."""
    return _named(config, settings_of(config).perturbations())


def ranges_of(config: Mapping[str, Any]) -> str:
    """Return the name of the ranges of random parameters that a run was trained with, or :data:`OWN`."""
    return _named(config, settings_of(config).parameter_ranges())


def settings_of(config: Mapping[str, Any]) -> LeggedRobotCfg:
    """Return today's settings of a run's task, or those of all robots if there is no such task any more."""
    try:
        return task_registry.get_cfgs(str(config["task"]), Options())[0]
    except UserError:
        return LeggedRobotCfg()


def _named(config: Mapping[str, Any], sets: dict[str, dict]) -> str:
    """Return the set with which a run agrees in all entries that both have, and at least one; else :data:`OWN`."""
    own = flat({"env": config["env"]})
    for name, changes in sets.items():
        shared = [(own[key], value) for key, value in flat({"env": changes}).items() if key in own]
        if shared and all(now == value for now, value in shared):
            return name
    return OWN
