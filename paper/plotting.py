"""Drawing to files, without a screen."""

from __future__ import annotations

import io
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from legged_torque.utils.errors import UserError
from legged_torque.utils.files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def load_pyplot() -> ModuleType:
    """Return ``matplotlib.pyplot``, set up to write files and open no windows; UserError if it is missing."""
    try:
        import matplotlib

        matplotlib.use("agg")
        from matplotlib import pyplot
    except ImportError:
        raise UserError("plots need the extra: pip install 'legged_torque[plots]'") from None
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
