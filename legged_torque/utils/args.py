"""The command line of the scripts, with legged_gym's names: the fields of :class:`Options` as arguments."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterable
from typing import Any

from legged_torque.utils.cli import Parser, slow_imports
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import describe, types_of
from legged_torque.utils.options import Options
from legged_torque.utils.task_registry import task_registry

_SETTINGS = ("task", "task_file", "seed", "perturbation", "ranges", "device", "set")
_RUNS = ("log_root", "experiment_name", "load_run", "checkpoint")
_TRAINING = ("max_iterations", "resume", "run_name", "preset", "logger", "verbose")
_GROUPS = {"task and settings": (*_SETTINGS, "num_envs"), "runs": _RUNS, "training": _TRAINING}


def add_settings_args(parser: Parser) -> None:
    """Add the options that choose a task and its settings."""
    add_options(parser, *_SETTINGS)


def add_build_args(parser: Parser) -> None:
    """Add the options with which a task is built."""
    add_options(parser, *_SETTINGS, "num_envs")


def add_task_args(parser: Parser) -> None:
    """Add the options of scripts that build a task and keep or load runs of it."""
    add_options(parser, *_SETTINGS, "num_envs", *_RUNS)
    hint = "for legged_gym's sake: no window is opened, which none is unless it is asked for"
    parser.add_argument("--headless", action="store_true", help=hint)


def add_train_args(parser: Parser) -> None:
    """Add the options of trainings alone."""
    add_options(parser, *_TRAINING)


def add_options(parser: Parser, *names: str) -> None:
    """Add fields of :class:`Options` in groups of ``--help``."""
    types, defaults = types_of(Options), Options()
    fields = {field.name: field for field in dataclasses.fields(Options)}
    for title, members in _GROUPS.items():
        chosen = [name for name in members if name in names]
        group = parser.add_argument_group(title) if chosen else parser
        for name in chosen:
            hint, how = types[name], {**fields[name].metadata, "default": getattr(defaults, name)}
            if hint is bool:
                how["action"] = "store_true"
            elif hint == list[str]:
                how["action"] = "append"
            elif hint not in (str, str | None):
                how |= {"type": int, "help": f"{how['help']}; {describe(hint).removesuffix(' or null')}"}
            if aliases := how.pop("aliases", ()):
                how["action"] = _OneValue
            action = group.add_argument(f"--{name}", *aliases, **how)
            if name == "task":
                action.completer = lambda **_: task_registry.names()  # type: ignore[attr-defined] # for argcomplete


class _OneValue(argparse.Action):
    """An option with several names, which must not be given different values; of a repeated name the last counts."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        """Keep the value; a UserError if another name has given another one."""
        self.given = {**getattr(self, "given", {}), option_string: values}
        if len(set(self.given.values())) > 1:
            given = ", ".join(f"{option}={value}" for option, value in self.given.items())
            raise UserError(f"these options mean the same, but differ: {given}")
        setattr(namespace, self.dest, values)


def options_of(args: argparse.Namespace) -> Options:
    """Return the shared options of a parsed command line, and load the files of tasks that it names.

    Options that its parser does not have keep their defaults.
    """
    names = [field.name for field in dataclasses.fields(Options)]
    options = Options(**{name: getattr(args, name) for name in names if hasattr(args, name)})
    if options.task_file:
        with slow_imports():
            task_registry.import_files(options.task_file)
    return options


def task_file_words(files: Iterable[str]) -> list[str]:
    """Return the arguments with which another script loads the same files of tasks."""
    return [f"--task_file={file}" for file in files]
