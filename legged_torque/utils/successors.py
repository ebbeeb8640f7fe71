"""Replacements of names that people know from legged_gym and from earlier versions."""

import functools
from pathlib import Path
from typing import Literal

import yaml


@functools.cache
def successors(kind: Literal["settings", "methods", "attributes"]) -> dict[str, str]:
    """Return the replacements in words, by name; settings have dotted paths."""
    return yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text("utf-8"))[kind]


def successor(kind: Literal["settings", "methods", "attributes"], name: str) -> str:
    """Return a sentence with the replacement of a name; empty for names that never existed."""
    new = successors(kind).get(name)
    return f"'{name}' is now {new}" if new else ""
