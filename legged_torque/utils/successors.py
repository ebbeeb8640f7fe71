"""What has become of names that people know, from legged_gym and from earlier versions."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Literal

import yaml


@functools.cache
def successors(kind: Literal["settings", "methods", "attributes"]) -> dict[str, str]:
    """Return what one uses in place of names, in words; settings have dotted paths."""
    return yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text("utf-8"))[kind]


def successor(kind: Literal["settings", "methods", "attributes"], name: str) -> str:
    """Return in words what one uses in place of a name; empty if it never was one."""
    new = successors(kind).get(name)
    return f"'{name}' is now {new}" if new else ""
