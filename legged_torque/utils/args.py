"""The command line of the scripts, with legged_gym's names."""

from __future__ import annotations

import argparse
import re
from typing import Any, NoReturn

import torch

from legged_torque.utils import distributed
from legged_torque.utils.cli import run_script as run_script
from legged_torque.utils.config import section_keys, set_by_path, update_from_dict
from legged_torque.utils.errors import UserError, unknown_name

DEFAULT_TASK = "a1_torque_multihead"


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line with the nearest valid name."""

    def __init__(self, description: str) -> None:
        """Create a parser; abbreviations of options are not accepted."""
        super().__init__(description=description, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        """Report a mistake in the arguments."""
        raise UserError(message)

    def parse_args(self, args: list[str] | None = None, namespace: argparse.Namespace | None = None):
        """Parse the command line.

        Raises:
            UserError: If it cannot be parsed.
        """
        namespace, unknown = self.parse_known_args(args, namespace)
        if unknown:
            options = [option for action in self._actions for option in action.option_strings]
            raise unknown_name("option", unknown[0], options)
        return namespace


def add_settings_args(parser: argparse.ArgumentParser) -> None:
    """Add what chooses a task and its settings."""
    parser.add_argument(
        "--task", default=DEFAULT_TASK, help="name of the task, see train.py --list; default: %(default)s"
    )
    parser.add_argument("--seed", type=int, help="random seed; default: that of the training settings")
    parser.add_argument(
        "--perturbation",
        help="random parameters, pushes and noise: none, low, high, high_frequency or doubled; default: none, or what "
        "a loaded run has",
    )
    parser.add_argument(
        "--ranges", help="how far random parameters go: wide or narrow; default: wide, or what a loaded run has"
    )
    parser.add_argument(
        "--device",
        default="auto",
        help="auto, cpu or cuda:N; auto takes the GPU if there is one, with torchrun one for each process",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a config entry by its dotted path, e.g. rewards.scales.torques=-1e-4; may be repeated",
    )


def add_build_args(parser: argparse.ArgumentParser) -> None:
    """Add what decides how a task is built."""
    add_settings_args(parser)
    parser.add_argument(
        "--num_envs", type=int, help="number of worlds, with torchrun those of each process; default: that of the task"
    )


def add_task_args(parser: argparse.ArgumentParser) -> None:
    """Add what all scripts take that build a task and keep or load runs of it."""
    add_build_args(parser)
    parser.add_argument("--log_root", help="folder that keeps all experiments; default: ./logs")
    parser.add_argument("--experiment_name", help="folder of the run below that; default: name of the task")
    parser.add_argument("--load_run", help="run to load: name of its folder or a path; default: the last one")
    parser.add_argument("--checkpoint", type=int, help="checkpoint to load; default: the last one")


def add_train_args(parser: argparse.ArgumentParser) -> None:
    """Add what only training takes."""
    parser.add_argument("--max_iterations", type=int, help="iterations in all; default: 110e6 environment steps")
    parser.add_argument(
        "--headless", action="store_true", help="accepted for legged_gym's sake: training has no window"
    )
    parser.add_argument("--resume", action="store_true", help="continue a run, with its settings")
    parser.add_argument("--run_name", help="added to the name of the run's folder")
    parser.add_argument("--preset", help="training settings: parallel (the default) or paper (Table II)")
    parser.add_argument("--logger", help="where curves are written: tensorboard, wandb or none")


def apply_args(env_cfg: Any, train_cfg: Any, args: argparse.Namespace) -> None:
    """Change settings as the command line asks; what is more explicit wins.

    In this order: the preset, the number of worlds that suits the device, the settings of a resumed run
    (``args.run_config``, if present), the perturbation, the ranges, single options, ``--set``.

    Raises:
        UserError: If an argument makes no sense.
    """
    apply_preset(env_cfg, train_cfg, getattr(args, "preset", None) or "parallel")
    if resolve_device(args.device) == "cpu":
        env_cfg.env.num_envs = env_cfg.env.num_envs_cpu
    run_config = getattr(args, "run_config", None)
    if run_config:
        update_from_dict(env_cfg, run_config["env"])
        update_from_dict(train_cfg, run_config["train"])
    if getattr(args, "perturbation", None):
        apply_perturbation(env_cfg, args.perturbation)
    if getattr(args, "ranges", None):
        apply_named("ranges", env_cfg.parameter_ranges(), env_cfg, args.ranges)
    given = {
        "env.num_envs": args.num_envs,
        "seed": args.seed,
        "runner.experiment_name": getattr(args, "experiment_name", None),
        "runner.run_name": getattr(args, "run_name", None),
        "runner.logger": getattr(args, "logger", None),
    }
    for path, value in given.items():
        if value is not None:
            set_entry_of_either(env_cfg, train_cfg, path, value)
    for item in args.set:
        path, separator, value = item.partition("=")
        if not separator:
            raise UserError(f"--set takes KEY=VALUE, not '{item}'")
        set_entry_of_either(env_cfg, train_cfg, path, value)
    if getattr(args, "max_iterations", None) is not None and args.max_iterations < 1:
        raise UserError(f"--max_iterations must be at least 1, not {args.max_iterations}")


def apply_preset(env_cfg: Any, train_cfg: Any, name: str) -> None:
    """Apply the named changes that the training settings offer as their presets.

    Raises:
        UserError: If there is no such preset.
    """
    presets = train_cfg.presets()
    if name not in presets:
        raise unknown_name("preset", name, presets)
    for section, values in presets[name].items():
        update_from_dict(env_cfg if section in section_keys(env_cfg) else train_cfg, {section: values})


def apply_perturbation(env_cfg: Any, name: str) -> None:
    """Apply one of the named sets of random events that the task's settings offer.

    Raises:
        UserError: If there is no such set.
    """
    apply_named("perturbation", env_cfg.perturbations(), env_cfg, name)


def apply_named(kind: str, choices: dict[str, dict], env_cfg: Any, name: str) -> None:
    """Apply one of several named sets of changes to the task's settings.

    Raises:
        UserError: If there is no such set.
    """
    if name not in choices:
        raise unknown_name(kind, name, choices)
    update_from_dict(env_cfg, choices[name])


def set_entry_of_either(env_cfg: Any, train_cfg: Any, path: str, value: Any) -> None:
    """Set an entry by its dotted path in the task's or the training's settings, whose sections differ in name.

    Raises:
        UserError: If neither has such an entry.
    """
    section = path.split(".")[0]
    sections = {key: cfg for cfg in (env_cfg, train_cfg) for key in section_keys(cfg)}
    if section not in sections:
        raise unknown_name("config section", section, sections)
    set_by_path(sections[section], path, value)


def resolve_device(device: str | None) -> str:
    """Return the name of the device to use. Processes that train together take a GPU each.

    Args:
        device: "auto", "cpu", "cuda" or "cuda:N"; None is "auto".

    Raises:
        UserError: If there is no such device, or not one for each process.
    """
    num_gpus = torch.cuda.device_count()
    available = ["cpu", *(f"cuda:{i}" for i in range(num_gpus))]
    if device in (None, "auto"):
        device = "cuda" if num_gpus else "cpu"
    if device == "cuda":
        num_processes = distributed.local_world_size()
        if 0 < num_gpus < num_processes:
            raise UserError(f"torchrun has started {num_processes} processes on a machine with {num_gpus} GPU(s)")
        device = f"cuda:{distributed.local_rank()}"
    elif device in available[1:] and distributed.world_size() > 1:
        raise UserError(f"with torchrun each process takes a GPU of its own: leave out --device {device}")
    if device not in available:
        if re.fullmatch(r"cuda:\d+", device):
            raise UserError(f"there is no device '{device}'; available: {', '.join(available)}")
        raise unknown_name("device", device, ["auto", *available])
    return device


def device_name(device: str) -> str:
    """Return what the machine calls the device."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU, {torch.get_num_threads()} threads"
