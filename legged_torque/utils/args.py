"""The command line of the scripts, with legged_gym's names: the fields of :class:`Options` as arguments."""

from __future__ import annotations

import argparse
import dataclasses

from legged_torque.utils.cli import Parser
from legged_torque.utils.limits import describe, types_of, without_null
from legged_torque.utils.options import Options

_SETTINGS = ("task", "seed", "perturbation", "ranges", "device", "set")
_RUNS = ("log_root", "experiment_name", "load_run", "checkpoint")
_TRAINING = ("max_iterations", "resume", "run_name", "preset", "logger", "verbose")


def add_settings_args(parser: Parser) -> None:
    """Add what chooses a task and its settings."""
    add_options(parser, *_SETTINGS)


def add_build_args(parser: Parser) -> None:
    """Add what decides how a task is built."""
    add_options(parser, *_SETTINGS, "num_envs")


def add_task_args(parser: Parser) -> None:
    """Add what all scripts take that build a task and keep or load runs of it."""
    add_options(parser, *_SETTINGS, "num_envs", *_RUNS)


def add_train_args(parser: Parser) -> None:
    """Add what only training takes."""
    add_options(parser, *_TRAINING)
    hint = "accepted for legged_gym's sake: training has no window"
    parser.add_argument("--headless", action="store_true", help=hint)


def add_options(parser: Parser, *names: str) -> None:
    """Add fields of :class:`Options`, which tell their help, type, limits and default."""
    hints = types_of(Options)
    for field in dataclasses.fields(Options):
        if field.name in names:
            default = field.default if field.default is not dataclasses.MISSING else []
            how = {"default": default, **field.metadata}
            if "type" in how:
                how["help"] += f"; {describe(without_null(hints[field.name]))}"
            parser.add_argument(f"--{field.name}", **how)


def options_of(args: argparse.Namespace) -> Options:
    """Return the shared options of a parsed command line; those that its parser does not have are not given."""
    names = [field.name for field in dataclasses.fields(Options)]
    return Options(**{name: getattr(args, name) for name in names if hasattr(args, name)})
