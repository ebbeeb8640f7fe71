"""The command line of the scripts, with legged_gym's names."""

from __future__ import annotations

import argparse
import dataclasses

from legged_torque.utils.cli import Parser
from legged_torque.utils.options import DEFAULT_TASK, Options


def add_settings_args(parser: Parser) -> None:
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


def add_build_args(parser: Parser) -> None:
    """Add what decides how a task is built."""
    add_settings_args(parser)
    parser.add_argument(
        "--num_envs", type=int, help="number of worlds, with torchrun those of each process; default: that of the task"
    )


def add_task_args(parser: Parser) -> None:
    """Add what all scripts take that build a task and keep or load runs of it."""
    add_build_args(parser)
    parser.add_argument("--log_root", help="folder that keeps all experiments; default: logs/ in the current directory")
    parser.add_argument("--experiment_name", help="folder of the run below that; default: name of the task")
    parser.add_argument("--load_run", help="run to load: name of its folder or a path; default: the last one")
    parser.add_argument("--checkpoint", type=int, help="checkpoint to load; default: the last one")


def add_train_args(parser: Parser) -> None:
    """Add what only training takes."""
    parser.add_argument("--max_iterations", type=int, help="iterations in all; default: 110e6 environment steps")
    parser.add_argument(
        "--headless", action="store_true", help="accepted for legged_gym's sake: training has no window"
    )
    parser.add_argument("--resume", action="store_true", help="continue a run, with its settings")
    parser.add_argument("--run_name", help="added to the name of the run's folder")
    parser.add_argument("--preset", help="training settings: parallel (the default) or paper (Table II)")
    parser.add_argument("--logger", help="where curves are written: tensorboard, wandb or none")


def options_of(args: argparse.Namespace) -> Options:
    """Return the shared options of a parsed command line; those that its parser does not have are not given."""
    names = [field.name for field in dataclasses.fields(Options)]
    return Options(**{name: getattr(args, name) for name in names if hasattr(args, name)})
