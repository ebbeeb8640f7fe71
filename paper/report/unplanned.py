"""Trainings made by ``train.py`` without a plan: those in a folder, and the names of their settings."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.experiments.matrix import SETTINGS_FILE, Cell, Matrix
from legged_torque.utils.config import flat
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import without_machine
from legged_torque.utils.options import Options
from legged_torque.utils.runs import CONFIG_FILE, load_config

OWN = "own"
"""Name of random events or ranges that match none of the published ones."""
PUSHES = ("push_velocity", "push_probability")
"""Settings without effect where robots are not pushed."""
NEUTRAL = {"add": [0.0, 0.0], "scale": [1.0, 1.0], "scale_per_joint": [1.0, 1.0]}
"""Ranges of a random parameter that do not change it, by operation."""
FREE: tuple[str, ...] = ("seed", "evaluation.", "distillation.teachers")
FREE += ("runner.experiment_name", "runner.save_interval", "runner.total_steps", "runner.logger")
"""Settings that do not change what is learned, or may differ between the runs of one training."""

Trainings = dict[Cell, list[Path]]
"""Folders of runs by training: the first run and those that continued it, in the order of their names."""


def find_trainings(folder: Path, problems: list[str]) -> Trainings:
    """Return the trainings in a folder; runs that cannot be read or had other teachers add messages to ``problems``.

    Runs of the same task, run name, settings, random events and seed are one training that was interrupted and resumed;
    of two that both began at 0, the later one counts. Settings that differ between runs of a task follow its name.

    Raises:
        UserError: If there is no run.
    """
    keys: dict[Path, tuple[str, str, int]] = {}
    configs: dict[Path, dict[str, Any]] = {}
    found = {file.parent for file in folder.rglob(CONFIG_FILE) if file.parent.suffix != ".part"}
    for run in sorted(found, key=lambda path: (path.name, path)):
        try:
            config = load_config(run)
            train = config["train"]
            task = " ".join(filter(None, [str(config["task"]), str(train["runner"].get("run_name") or "")]))
            keys[run] = (task, environment_of(config), int(train["seed"]))
            configs[run] = flat({**config["env"], **train})
        except (UserError, LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            problems.append(f"the run '{run.relative_to(folder)}' cannot be read: {error}")
    if not keys:
        raise UserError(f"there is neither a file '{folder / SETTINGS_FILE}' nor a run with its {CONFIG_FILE}")
    names: dict[Path, tuple[str, str]] = {}  # with paths of the machine, and without
    for run, (task, environment, _) in keys.items():
        others = [configs[other] for other, key in keys.items() if key[:2] == (task, environment)]
        changes = differing(configs[run], others)
        names[run] = " ".join([task, *changes]), " ".join([task, *without_machine(changes)])
    shorter = dict(names.values())
    runs: dict[tuple[str, str, int], list[Path]] = {}
    for run, (_, environment, seed) in keys.items():
        whole, short = names[run]
        name = whole if [*shorter.values()].count(short) > 1 else short
        runs.setdefault((name, environment, seed), []).append(run)
    trainings: Trainings = {}
    for key, parts in sorted(runs.items()):
        if len({str(configs[part].get("distillation.teachers")) for part in parts}) > 1:
            training = f"{key[0]} in {key[1]}, seed {key[2]}"
            problems.append(f"{training}, has runs of other teachers; of two that began at 0, the later one counts")
        also = configs[parts[-1]].get("evaluation.also") or ()
        trainings[Cell(parts[-1], *key, tuple(dict.fromkeys([key[1], *map(str, also)])))] = parts
    return trainings


def differing(settings: Mapping[str, Any], others: list[dict[str, Any]]) -> list[str]:
    """Return "path=value" of each setting, except :data:`FREE` ones, that differs in one of the ``others``."""
    paths = [path for path in settings if not path.startswith(FREE)]
    return [f"{path}={settings[path]}" for path in paths if any(other.get(path) != settings[path] for other in others)]


def plan_of(trainings: Trainings) -> Matrix:
    """Return the tasks, environments and seeds of trainings as a plan."""
    environments: dict[str, list[str]] = {}
    for cell in trainings:
        names = environments.setdefault(cell.environment, [])
        names += [name for name in cell.evaluated_in if name not in names]
    tasks = list(dict.fromkeys(cell.task for cell in trainings))
    return Matrix(tasks, environments, sorted({cell.seed for cell in trainings}))


def environment_of(config: Mapping[str, Any]) -> str:
    """Return the name of the random events of a run, or :data:`OWN`."""
    settings = settings_of(config)
    sets = settings.perturbations()
    if not config["env"]["domain_rand"].get("push_robots"):
        for changes, name in product(sets.values(), PUSHES):
            del changes["domain_rand"][name]
    return _matching(settings.upgraded(config["env"]), sets)


def ranges_of(config: Mapping[str, Any]) -> str:
    """Return the name of the ranges of random parameters of a run, or :data:`OWN`."""
    settings = settings_of(config)
    try:
        return _matching(settings.upgraded(config["env"]), settings.parameter_ranges())
    except (LookupError, TypeError, ValueError, AttributeError):  # no settings of a task
        return OWN


def settings_of(config: Mapping[str, Any]) -> LeggedRobotCfg:
    """Return the present settings of a run's task, or those of all robots if the task no longer exists."""
    try:
        return task_registry.get_cfgs(str(config["task"]), Options())[0]
    except UserError:
        return LeggedRobotCfg()


def _matching(own: dict[str, dict[str, Any]], sets: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Return the set that agrees with settings in all entries that both have, and at least one; else :data:`OWN`."""
    for name, changes in sets.items():
        keys = [(section, key) for section in changes for key in changes[section] if key in own.get(section, {})]
        if keys and all(_effective(own[section][key]) == _effective(changes[section][key]) for section, key in keys):
            return name
    return OWN


def _effective(value: Any) -> Any:
    """Return a setting; of the ranges of a random parameter, those that change it."""
    return {key: part for key, part in value.items() if part != NEUTRAL.get(key)} if isinstance(value, dict) else value
