"""What came out on rough ground: shares of robots that cross tiles, by kind and difficulty, of one training."""

from __future__ import annotations

import json
import math
from pathlib import Path
from statistics import fmean

MEASURES = {
    "crossed": ("Share of robots that crossed their tile in time", 2),
    "fell": ("Share of robots that fell", 2),
    "track_percentage": ("Tracking", 2),
    "cost_of_transport": ("Cost of transport", 2),
}
"""What is shown of a tile: its meaning, and decimals in tables."""

Tile = tuple[str, float]
"""Kind and difficulty."""
Crossings = dict[Tile, dict[str, float]]
"""The :data:`MEASURES` of each tile; NaN where nothing was measured."""


def read_crossings(file: Path, notes: list[str]) -> Crossings:
    """Return what ``evaluate.py --terrain`` has written; nothing without a file, and a note if it is unreadable."""
    if not file.is_file():
        return {}
    try:
        entries = json.loads(file.read_text(encoding="utf-8"))["grounds"]
        return {(str(entry["kind"]), float(entry["level"])): _numbers(entry) for entry in entries}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        notes.append(f"'{file}' cannot be read")
        return {}


def kinds_of(crossings: list[Crossings]) -> list[str]:
    """Return the kinds of all tiles, each once."""
    return list(dict.fromkeys(kind for each in crossings for kind, _ in each))


def by_level(crossings: Crossings, measure: str, kind: str | None = None) -> dict[float, float]:
    """Return the mean of a measure by difficulty, over the tiles of a kind or all kinds; NaN without numbers."""
    values: dict[float, list[float]] = {}
    for (name, level), tile in sorted(crossings.items()):
        if kind in (None, name):
            values.setdefault(level, []).append(tile[measure])
    return {level: finite_mean(numbers) for level, numbers in values.items()}


def over_levels(crossings: Crossings, measure: str, kind: str | None = None) -> float:
    """Return the mean of a measure over the tiles of a kind, or of all; NaN without numbers."""
    return finite_mean([tile[measure] for (name, _), tile in crossings.items() if kind in (None, name)])


def finite_mean(values: list[float]) -> float:
    """Return the mean of what is finite; NaN if nothing is."""
    finite = [value for value in values if math.isfinite(value)]
    return fmean(finite) if finite else math.nan


def _numbers(entry: dict) -> dict[str, float]:
    """Return the measures of an entry of the file; null is NaN."""
    estimates = {name: entry[name] if name in entry else entry["metrics"][name] for name in MEASURES}
    return {name: math.nan if part["mean"] is None else float(part["mean"]) for name, part in estimates.items()}
