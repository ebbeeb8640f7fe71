"""Paths in files that are committed: none names a folder of one machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def portable_path(path: str | Path) -> str:
    """Return a path relative to the current folder; only its name if it is absolute and lies elsewhere."""
    path = Path(path)
    if not path.is_absolute():
        return str(path)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else path.name


def without_machine(value: Any) -> Any:
    """Return settings with every absolute path, alone or as KEY=PATH, replaced by :func:`portable_path`."""
    if isinstance(value, dict):
        return {key: without_machine(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [without_machine(entry) for entry in value]
    if not isinstance(value, str):
        return value
    key, equals, path = value.rpartition("=")
    return key + equals + portable_path(path) if Path(path).is_absolute() else value
