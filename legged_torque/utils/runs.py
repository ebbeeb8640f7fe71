"""Run folders: ``logs/<experiment>/<date and time>[_<run name>]`` with checkpoints, events and ``config.yaml``."""

import contextlib
import errno
import functools
import importlib.metadata
import math
import platform
import re
import shlex
import shutil
import subprocess
import sys
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from legged_torque import __version__
from legged_torque.utils.errors import UserError, check_names
from legged_torque.utils.files import is_whole_archive, part_of, remove_stale_parts, write_errors, write_whole
from legged_torque.utils.plain_yaml import dump_yaml, parse_yaml

CONFIG_FILE = "config.yaml"
EVALUATIONS_FILE = "evaluations.csv"  # a row per evaluation during training
PRETRAINED = "pretrained"  # folder of pre-trained policies, in that of all experiments
MOVED = {"legged_torque.control.gravity_pretraining:pretrain": "legged_torque.paper.gravity.pretraining:pretrain"}
"""Present names of functions that the settings of older runs name by their former modules."""
NAME, NAME_LENGTH = "%Y-%m-%d_%H-%M-%S", 19  # of a run, by its start, in local time; in characters
_CHECKPOINT = "model_"
_PACKAGES = ("torch", "warp-lang", "mujoco", "mujoco-warp", "rsl-rl-lib", "numpy")


def new_run_dir(log_root: Path, run_name: str) -> Path:
    """Return the folder for a run that starts now; it is not created yet.

    Even after the clock was set back, its name is later than those of all other runs: the last by name is the newest.
    """
    now = datetime.now()
    for path in log_root.glob("*"):
        with contextlib.suppress(ValueError, OverflowError):  # of another name, or of the year 9999
            now = max(now, datetime.strptime(path.name[:NAME_LENGTH], NAME) + timedelta(seconds=1))
    return log_root / tagged(now.strftime(NAME), run_name)


def claim_run_dir(run_dir: Path, config: dict[str, Any]) -> Path:
    """Create a run's folder with its settings and return it; a UserError if it cannot be written.

    A number is added if another run that started just now has taken the name. No folder is ever without its settings.
    """
    with write_errors(run_dir):
        remove_stale_parts(run_dir.parent)
        part, candidate, number = part_of(run_dir), run_dir, 1
        try:
            save_config(part, config)
            while True:
                try:
                    return part.rename(candidate)
                except OSError as error:
                    if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                        raise
                number += 1
                candidate = run_dir.with_name(f"{run_dir.name}_{number}")
        finally:
            shutil.rmtree(part, ignore_errors=True)


def tagged(word: str, name: str) -> str:
    """Return a word for something that may have a name: ``<word>_<name>``, or the word alone without one."""
    return f"{word}_{name}" if name else word


def evaluations_file(run_dir: Path, environment: str = "") -> Path:
    """Return the file of a run's evaluations while it trained, or of those in one of ``evaluation.also``."""
    file = run_dir / EVALUATIONS_FILE
    return file.with_stem(tagged(file.stem, environment))


def by_age(run_dir: Path) -> tuple[bool, str]:
    """Return a key that sorts runs by age: a name that begins with no date, as of a copy, is older than all others."""
    return re.match(r"\d{4}-\d\d-\d\d_", run_dir.name) is not None, run_dir.name


def find_run(root: Path, load_run: str | None, pattern: str = "*") -> Path:
    """Return the folder of a run, or raise a UserError if there is none.

    Args:
        root: Folder of an experiment.
        load_run: Name of the run's folder, or a path to it; None is the newest one that has a whole checkpoint.
        pattern: Where runs are in the folder: "*/*" in that of all experiments.
    """
    if load_run and Path(load_run).is_dir():
        folder = Path(load_run)
        return folder if folder.name.strip(".") else folder.resolve()  # "." and ".." are no names of runs
    runs = sorted(filter(checkpoint_numbers, root.glob(pattern)), key=lambda path: (by_age(path), path))
    if not runs:
        raise UserError(f"there is no run with a checkpoint in '{root}'; train first")
    if not load_run:
        return next(filter(newest_checkpoint, reversed(runs)), runs[-1])
    check_names("run", [load_run], [path.name for path in runs])
    named = [path for path in runs if path.name == load_run]
    if len(named) > 1:
        raise UserError(f"there are several runs '{load_run}'; give the path of one: {', '.join(map(str, named))}")
    return named[0]


def find_checkpoint(run_dir: Path, checkpoint: int | None) -> Path:
    """Return the file of a run's checkpoint after some iterations, or raise a UserError.

    None is the last one that is whole, or the last one if none is.
    """
    numbers = checkpoint_numbers(run_dir)
    if not numbers:
        raise UserError(f"there is no checkpoint in '{run_dir}'")
    if checkpoint is None:
        return newest_checkpoint(run_dir) or checkpoint_file(run_dir, numbers[-1])
    check_names("checkpoint", [str(checkpoint)], [*map(str, numbers)])
    return checkpoint_file(run_dir, checkpoint)


def find_checkpoint_of(root: Path, name: str) -> Path:
    """Return the checkpoint that a name means: a file, or the last one of a run as of :func:`find_run`; a UserError."""
    if not name.endswith(".pt"):
        return find_checkpoint(find_run(root, name), None)
    if not is_whole_archive(Path(name)) or not Path(name).stem.removeprefix(_CHECKPOINT).isdecimal():
        raise UserError(f"'{name}' is no whole checkpoint, such as {_CHECKPOINT}50.pt in the folder of a run")
    return Path(name)


def newest_checkpoint(run_dir: Path) -> Path | None:
    """Return the file of a run's last checkpoint that is not damaged, or None."""
    files = (checkpoint_file(run_dir, number) for number in reversed(checkpoint_numbers(run_dir)))
    return next(filter(is_whole_archive, files), None)


def checkpoint_file(run_dir: Path, iterations: int) -> Path:
    """Return the file of the checkpoint after a number of iterations."""
    return run_dir / f"{_CHECKPOINT}{iterations}.pt"


def checkpoint_number(file: Path) -> int:
    """Return the number of iterations after which a checkpoint was saved."""
    return int(file.stem.removeprefix(_CHECKPOINT))


def checkpoint_numbers(run_dir: Path) -> list[int]:
    """Return the iterations after which a run has saved checkpoints, in rising order."""
    files = run_dir.glob(f"{_CHECKPOINT}*.pt")
    return sorted(checkpoint_number(file) for file in files if file.stem.removeprefix(_CHECKPOINT).isdecimal())


def save_config(run_dir: str | Path, config: dict[str, Any]) -> None:
    """Write a run's settings, its command, and the versions of packages, between YAML's marks of a document."""
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    content = {**config, "command": command, "versions": package_versions()}
    write_whole(Path(run_dir) / CONFIG_FILE, dump_yaml(content, explicit_start=True, explicit_end=True))


def load_config(run_dir: Path) -> dict[str, Any]:
    """Return the content of a file of :func:`save_config`; a UserError if it is missing, broken or not whole."""
    file = run_dir / CONFIG_FILE
    if not file.is_file():
        raise UserError(f"the run '{run_dir}' has no {CONFIG_FILE}")
    text = file.read_text(encoding="utf-8", errors="replace")
    config = parse_yaml(text, f"'{file}'")
    if not isinstance(config, dict) or not {"task", "env", "train"} <= config.keys():
        raise UserError(f"'{file}' lacks the entries task, env and train")
    if text.startswith("---") and not text.endswith("\n...\n"):
        raise UserError(f"'{file}' is not whole: its end is missing")
    return with_present_names(config)


def with_present_names(settings: Any) -> Any:
    """Return settings in which functions that have :data:`MOVED` have their present names."""
    if isinstance(settings, dict):
        return {key: with_present_names(value) for key, value in settings.items()}
    return MOVED.get(settings, settings) if isinstance(settings, str) else settings


def steps_per_iteration(config: dict[str, Any]) -> int | None:
    """Return how many steps of all worlds an iteration of a run takes, by its settings; None if they do not say."""
    try:
        rollout = config["env"]["env"]["num_envs"], config["train"]["runner"]["num_steps_per_env"]
    except (KeyError, TypeError):
        return None
    factors = (*rollout, config.get("processes", 1))
    return math.prod(factors) if all(type(factor) is int for factor in factors) else None


def given_iterations(config: dict[str, Any]) -> int | None:
    """Return how many iterations a run was told to make; None if they are what its settings say, or unknown.

    A UserError if the file has no number there.
    """
    is_new = "given_iterations" in config
    iterations, steps = config.get("given_iterations" if is_new else "max_iterations"), steps_per_iteration(config)
    if iterations is not None and not isinstance(iterations, int):
        raise UserError(f"the run's config.yaml has no number of iterations, but {iterations!r}")
    if is_new:  # not said by older runs
        return iterations
    try:
        is_of_settings = 0 <= iterations * steps - config["train"]["runner"]["total_steps"] < steps  # type: ignore[operator]
    except (KeyError, TypeError):
        return iterations
    return None if is_of_settings else iterations


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide how a training goes.

    That of this package has the commit of a checkout, and whether files were changed since: "0.1.0+g62a7aea.dirty".
    """
    versions = {"python": platform.python_version(), **dict.fromkeys(_PACKAGES, "not installed")}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    versions["legged_torque"] = __version__ + commit()
    return versions


@functools.cache
def commit() -> str:
    """Return what a checkout adds to the version; empty without git, and for an installed package."""
    root = Path(__file__).resolve().parents[2]
    words = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    if (root / ".git").exists():
        with contextlib.suppress(OSError, subprocess.CalledProcessError):
            done = subprocess.run(words, capture_output=True, text=True, check=True)
            return f"+g{done.stdout.strip().replace('-', '.')}"
    return ""
