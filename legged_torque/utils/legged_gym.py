"""What has become of legged_gym's names, for everybody who brings a task from there."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Literal

import yaml


@functools.cache
def _names() -> dict[str, dict[str, str]]:
    """Return the successors of all names, by kind."""
    return yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text("utf-8"))


def successor(kind: Literal["settings", "methods", "attributes"], name: str) -> str:
    """Return what one uses here in place of a name of legged_gym, in words; empty if it is none of its names.

    Settings have dotted paths.
    """
    new = _names()[kind].get(name)
    return f"legged_gym's {name}: {new}" if new else ""
