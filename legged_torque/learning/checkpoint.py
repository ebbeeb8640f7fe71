"""Files of tensors: written atomically, read without running code of theirs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from legged_torque.utils.errors import UserError


def write(file: Path, content: dict[str, Any]) -> None:
    """Write tensors and plain values; the file is either complete or absent, whoever else writes it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f"{file.name}.{os.getpid()}.part")
    try:
        torch.save(content, part)
        os.replace(part, file)
    finally:
        part.unlink(missing_ok=True)


def read(file: Path, what: str, device: str) -> Any:
    """Return what :func:`write` has written, on a device; a UserError that names ``what`` if it cannot be read."""
    try:
        return torch.load(file, weights_only=True, map_location=device)
    except Exception as error:  # torch raises about anything for a file that is not its own
        raise UserError(f"'{file}' is not a readable {what}: {last_line(error)}") from None


def last_line(error: Exception) -> str:
    """Return the line of an error's message that says most."""
    return str(error).strip().splitlines()[-1].strip() if str(error).strip() else type(error).__name__
