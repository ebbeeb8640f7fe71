"""What every script needs: a parser of its command line, and an end that a user expects. Needs no torch."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from legged_torque.utils.errors import UserError, unknown_name


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line with the nearest valid name."""

    def __init__(self, description: str) -> None:
        """Create a parser; abbreviations of options are not accepted."""
        super().__init__(description=description, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        """Report a mistake in the arguments."""
        raise UserError(message)

    def parse_args(self, args=None, namespace=None):
        """Parse the command line.

        Raises:
            UserError: If it cannot be parsed.
        """
        namespace, unknown = self.parse_known_args(args, namespace)
        if unknown:
            options = [option for action in self._actions for option in action.option_strings]
            raise unknown_name("option", unknown[0], options)
        return namespace


def run_script(main: Callable[[], None]) -> None:
    """Run a script's main function; what is no bug of ours ends it without a traceback.

    A user's mistake ends it with one line and exit status 2, Ctrl-C with 130, an output that nobody reads any more
    (``| head``) with 1.
    """
    gc.freeze()  # what has been imported stays: searching it for garbage at the end would take a second or two
    try:
        main()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python writes what is left when it ends
        sys.exit(1)


def prepare_file(file: Path) -> None:
    """Make the folder of a file that will be written when the work is done.

    Raises:
        UserError: If that is not possible, or the file is a folder.
    """
    if file.is_dir():
        raise UserError(f"cannot write '{file}': it is a folder")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot make the folder '{file.parent}': {error.strerror}") from None
