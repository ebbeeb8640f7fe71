"""Drawing without a screen."""

from __future__ import annotations

import json
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


def read_data(file: Path, keys: set[str], script: str) -> dict[str, Any]:
    """Return what a script has written as JSON.

    Args:
        file: The file.
        keys: What it must have.
        script: Name of the script, for the message.

    Raises:
        UserError: If the file is not such a one.
    """
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read '{file}': {error}") from None
    if not isinstance(data, dict) or not keys <= data.keys():
        raise UserError(f"'{file}' is not a file that {script} has written")
    return data


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
