"""What every script needs: a parser of its command line, and an end that a user expects. Needs no torch."""

from __future__ import annotations

import argparse
import contextlib
import errno
import gc
import json
import math
import os
import re
import shutil
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

from legged_torque import SCRIPTS_DIR
from legged_torque.utils.errors import TrainingError, UserError, is_out_of_memory, unknown_name
from legged_torque.utils.interrupt import end_on_interrupt, raise_on_interrupt

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

        When a shell asks how a command line may go on, it is told so, and the script ends.
        """
        if "_ARGCOMPLETE" in os.environ:
            import argcomplete

            argcomplete.autocomplete(self)
        words = sys.argv[1:] if args is None else list(args)
        for before, word in zip(["", *words], words, strict=False):
            name, equals, value = word.partition("=") if word.startswith("--") else (before, "", word)
            if not value and (equals or not word):
                raise UserError(f"the value of {name} is empty" if name else "an argument is empty")
        namespace, unknown = self.parse_known_args(words, namespace)
        if unknown:
            options = [option for action in self._actions for option in action.option_strings]
            raise unknown_name("option", unknown[0], options)
        return namespace


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Import inside what takes seconds, torch and Warp, after all that can be told without it.

    Ctrl-C ends the process without a traceback. The garbage collector rests, and what has been imported stays out of
    its sight: searching that took a third of the time, and would take a second or two at the end.
    """
    end_on_interrupt()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
        raise_on_interrupt()
    if "mujoco" in sys.modules:  # which would write its warnings to a file in the current folder
        sys.modules["mujoco"].set_mju_user_warning(lambda text: print(f"MuJoCo: {text}", file=sys.stderr))


def run_script(main: Callable[[], None]) -> None:
    """Run a script's main function; expected errors exit without a traceback.

    Exit status 2 for a user's mistake, a file that cannot be used or too little memory, 130 for Ctrl-C, 1 for a
    training that cannot learn or an output that nobody reads any more (``| head``).
    """
    try:
        raise_on_interrupt()
        main()
    except UserError as error:
        print("error:", " ".join(str(error).splitlines()), file=sys.stderr)
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
    except Exception as error:
        if isinstance(error, OSError) and error.filename is not None:
            print(f"error: {error.strerror}: {str(error.filename)!r}", file=sys.stderr)
        elif isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("legged_torque"):
            print(f"error: '{error.name}' is not installed; pip install legged_torque brings it along", file=sys.stderr)
        elif is_out_of_memory(error):
            reason = str(error).strip().splitlines() or ["nothing is left"]
            print("error: this does not fit in memory, lower --num_envs:", reason[0], file=sys.stderr)
        else:
            raise
        sys.exit(2)


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


def write_json(file: Path, value: Any) -> None:
    """Write a value with null in place of what is not a finite number, which JSON does not know."""

    def without_nan(part: Any) -> Any:
        if isinstance(part, dict):
            return {key: without_nan(entry) for key, entry in part.items()}
        if isinstance(part, list):
            return [without_nan(entry) for entry in part]
        return None if isinstance(part, float) and not math.isfinite(part) else part

    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(without_nan(value), indent=1) + "\n", encoding="utf-8")


def check_output(file: Path) -> None:
    """Raise a UserError if a file cannot be written when the work is done; nothing is created or changed yet."""
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
