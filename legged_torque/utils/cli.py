"""Parsing of command lines, and errors as one line with an exit status. Needs no torch."""

from __future__ import annotations

import argparse
import contextlib
import errno
import gc
import math
import os
import re
import shutil
import signal
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

from legged_torque import SCRIPTS_DIR
from legged_torque.utils.errors import TrainingError, UserError, is_out_of_memory, unknown_name
from legged_torque.utils.rendering import disable_renderer

MAX_NAME = 255  # bytes of the name of a file, on the usual systems
COMMAND = "legged-torque"  # the console command that runs every script
_SCRIPT = re.compile(r"python scripts/(\w+)\.py")
_EXAMPLE = re.compile(r": ``(python scripts/[^`]+)``")


def script_command(script: str) -> str:
    """Return how a script is started: as this one was, by the command, from a clone or as a part of the package."""
    if sys.argv[0].startswith(f"{COMMAND} "):
        return f"{COMMAND} {script}"
    if SCRIPTS_DIR.parent == Path(__file__).resolve().parents[1]:
        return f"python -m legged_torque.scripts.{script}"
    file = SCRIPTS_DIR / f"{script}.py"
    return f"python {file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file}"


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line with the nearest valid name."""

    def __init__(self, description: str) -> None:
        """Create a parser; abbreviations of options are not accepted.

        ``description`` is the docstring of a script. The example in its first line, or those below a line "Examples:",
        stand at the end of the help.
        """
        text, _, examples = description.partition("\nExamples:\n")
        examples += "".join(f"    {example}\n" for example in _EXAMPLE.findall(text))
        width = max(shutil.get_terminal_size().columns - 2, 20)  # argparse's own
        super().__init__(
            description="\n\n".join(textwrap.fill(part, width) for part in _EXAMPLE.sub("", text).split("\n\n")),
            epilog=examples and "examples:\n" + _SCRIPT.sub(lambda found: script_command(found[1]), examples.rstrip()),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )

    def error(self, message: str) -> NoReturn:
        """Report a mistake in the arguments."""
        raise UserError(message)

    def parse_args(self, args=None, namespace=None):
        """Parse the command line; an option that does not exist, or a value that is empty, is a UserError.

        When a shell asks for completions of a command line, they are printed, and the script ends.
        """
        if "_ARGCOMPLETE" in os.environ:
            import argcomplete

            argcomplete.autocomplete(self)
        words = sys.argv[1:] if args is None else list(args)
        for before, word in zip(["", *words], words, strict=False):
            name, equals, value = word.partition("=") if word.startswith("--") else (before, "", word)
            if (equals or not word) and value in ("", "--"):  # argparse would take --option=-- as no value
                raise UserError(f"the value of {name} is empty" if name else "an argument is empty")
        namespace, unknown = self.parse_known_args(words, namespace)
        if unknown:
            options = [option for action in self._actions for option in action.option_strings]
            raise unknown_name("option", unknown[0], options)
        return namespace


@contextlib.contextmanager
def slow_imports() -> Iterator[None]:
    """Context for imports that take seconds, of torch and Warp. Check the command line before.

    Ctrl-C ends the process without a traceback. The garbage collector is off, and never searches what was imported:
    that took a third of the time, and a second or two at the end.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
    if "mujoco" in sys.modules:  # which would write its warnings to a file in the current folder
        sys.modules["mujoco"].set_mju_user_warning(lambda text: print(f"MuJoCo: {text}", file=sys.stderr))


def run_script(main: Callable[[], None], draws: bool = False) -> None:
    """Run the main function of a script; expected errors are one line without a traceback.

    The exit status is 2 for a mistake of the user, a file that cannot be used or too little memory, 130 after Ctrl-C,
    and 1 for a training that cannot learn or an output that is not read any more (``| head``).

    Args:
        main: Takes no arguments.
        draws: Whether the script chooses a renderer; others must not depend on one.
    """
    if not draws:
        disable_renderer()
    try:
        main()
    except TrainingError as error:
        _end(1, f"error: {error}")
    except KeyboardInterrupt:
        _end(130, "interrupted")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python writes when it ends
        sys.exit(1)
    except Exception as error:
        if isinstance(error, UserError):
            message = " ".join(str(error).splitlines())
        elif isinstance(error, OSError):
            message = f"{error.strerror or error}" + (f": {str(error.filename)!r}" if error.filename else "")
        elif isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("legged_torque"):
            message = f"'{error.name}' is not installed; pip install legged_torque brings it along"
        elif is_out_of_memory(error):
            reason = (str(error).strip() or "no reason is given").splitlines()[0]
            message = f"this does not fit in memory, lower --num_envs: {reason}"
        else:
            raise
        _end(2, f"error: {message}")


def _end(status: int, message: str) -> NoReturn:
    """End the process with a line on standard error."""
    print(message, file=sys.stderr)
    sys.exit(status)


def check_at_least(args: object, lowest: int, *names: str) -> None:
    """Raise a UserError if one of the named arguments is lower, NaN, infinite or too large to count."""
    for name in names:
        value = getattr(args, name)
        if not value >= lowest:
            raise UserError(f"--{name} must be at least {lowest}, not {value}")
        if value >= 2**31:
            raise UserError(f"--{name} is too large: {value}")


def finite(text: str) -> float:
    """Return the number that an argument gives, as its ``type``; NaN and infinity are refused."""
    if not math.isfinite(float(text)):
        raise argparse.ArgumentTypeError(f"it must be finite, not {text}")
    return float(text)


def add_command_arg(parser: Parser) -> None:
    """Add a fixed command of the robots."""
    hint = "fixed command: forwards, to the left [m/s], yaw rate [rad/s]; default: drawn as in training"
    parser.add_argument("--command", type=finite, nargs=3, metavar=("X", "Y", "YAW"), help=hint)


def check_output(file: Path) -> None:
    """Raise a UserError if a file cannot be written later; nothing is created or changed yet."""
    try:
        if file.is_dir():
            raise UserError(f"cannot write '{file}': it is a folder")
        if file.exists():
            file.open("ab").close()
        else:
            folder = next(parent for parent in file.absolute().parents if parent.exists())
            with tempfile.TemporaryFile(dir=folder):
                too_long = max(len(os.fsencode(part)) for part in file.parts) > MAX_NAME
            if too_long:
                raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
    except OSError as error:
        raise UserError(f"cannot write '{file}': {error.strerror}") from None
