"""Drawing without a screen."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

from legged_torque.utils.errors import UserError


def load_pyplot() -> ModuleType:
    """Return ``matplotlib.pyplot``, which then writes files and opens no windows.

    Raises:
        UserError: If matplotlib is missing.
    """
    try:
        import matplotlib

        matplotlib.use("agg")
        from matplotlib import pyplot
    except ImportError:
        raise UserError("plots need the extra: pip install -e .[plots]") from None
    return pyplot


def save_figure(figure: Any, file: Path) -> None:
    """Write a picture; its ending says in which format.

    Raises:
        UserError: If it cannot be written, or the format is unknown.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(file, dpi=130)
    except (OSError, ValueError) as error:  # ValueError: of an unknown format
        raise UserError(f"cannot write '{file}': {error}") from None
