"""What every script needs: a parser of its command line, and an end that a user expects. Needs no torch."""

from __future__ import annotations

import argparse
import gc
import json
import math
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from legged_torque.utils.errors import TrainingError, UserError, unknown_name


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line with the nearest valid name."""

    def __init__(self, description: str) -> None:
        """Create a parser; abbreviations of options are not accepted."""
        super().__init__(description=description, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        """Report a mistake in the arguments."""
        raise UserError(message)

    def parse_args(self, args=None, namespace=None):
        """Parse the command line; an option that does not exist is a UserError."""
        namespace, unknown = self.parse_known_args(args, namespace)
        if unknown:
            options = [option for action in self._actions for option in action.option_strings]
            raise unknown_name("option", unknown[0], options)
        return namespace


def run_script(main: Callable[[], None]) -> None:
    """Run a script's main function; expected errors exit without a traceback.

    Exit status 2 for a user's mistake, 130 for Ctrl-C, 1 for a training that cannot learn or an output that nobody
    reads any more (``| head``).
    """
    gc.freeze()  # what has been imported stays: searching it for garbage at the end would take a second or two
    if "mujoco" in sys.modules:  # which would write its warnings to a file in the current folder
        sys.modules["mujoco"].set_mju_user_warning(lambda text: print(f"MuJoCo: {text}", file=sys.stderr))
    try:
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # see end_on_interrupt
            signal.signal(signal.SIGINT, signal.default_int_handler)
        main()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except TrainingError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # nobody reads the output any more (| head)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python writes what is left when it ends
        sys.exit(1)


def check_at_least(args: argparse.Namespace, lowest: int, *names: str) -> None:
    """Raise a UserError if one of the named arguments is lower, or NaN."""
    for name in names:
        if not getattr(args, name) >= lowest:
            raise UserError(f"--{name} must be at least {lowest}, not {getattr(args, name)}")


def add_command_arg(parser: Parser) -> None:
    """Add a fixed command of the robots."""
    hint = "fixed command [m/s, m/s, rad/s]; default: drawn as in training"
    parser.add_argument("--command", type=float, nargs=3, metavar=("X", "Y", "YAW"), help=hint)


def write_json(file: Path, value: Any) -> None:
    """Write a value with null in place of what is not a finite number, which JSON does not know."""

    def finite(part: Any) -> Any:
        if isinstance(part, dict):
            return {key: finite(entry) for key, entry in part.items()}
        if isinstance(part, list):
            return [finite(entry) for entry in part]
        return None if isinstance(part, float) and not math.isfinite(part) else part

    file.write_text(json.dumps(finite(value), indent=1) + "\n", encoding="utf-8")


def prepare_file(file: Path) -> None:
    """Make the folder of a file that will be written when the work is done; a UserError if that is not possible."""
    if file.is_dir():
        raise UserError(f"cannot write '{file}': it is a folder")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot make the folder '{file.parent}': {error.strerror}") from None
