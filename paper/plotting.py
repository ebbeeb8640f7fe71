"""Drawing to files, without a screen."""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from legged_torque.utils.cli import Parser, check_output
from legged_torque.utils.errors import UserError, require
from legged_torque.utils.files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def parse_figure(description: str, name: str, help_text: str, **how: Any) -> argparse.Namespace:
    """Return the command line of a figure: what it is made of, ``name``, and the file to write, ``out``."""
    parser = Parser(description)
    parser.add_argument(name, type=Path, help=help_text, **how)
    parser.add_argument("--out", type=Path, required=True, help="figure to write (png, svg, pdf)")
    args = parser.parse_args()
    check_output(args.out)
    return args


def load_pyplot() -> ModuleType:
    """Return ``matplotlib.pyplot``, set up to write files and open no windows; UserError if it is missing."""
    require("matplotlib", extra="plots")
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    return pyplot


def save_figure(figure: Figure, file: Path) -> None:
    """Write a figure in the format that the file's ending names; UserError if that is unknown or cannot be written."""
    if not file.suffix:
        raise UserError(f"cannot write '{file}': a figure needs a name that ends in .png, .svg or .pdf")
    content = io.BytesIO()
    try:
        figure.savefig(content, dpi=130, format=file.suffix[1:])
    except ValueError as error:
        raise UserError(f"cannot write '{file}': {error}") from None
    write_whole(file, content.getvalue())
