"""A benchmark against an earlier one, from the file that ``benchmark.py --json`` wrote."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from legged_torque.utils.errors import UserError
from legged_torque.utils.files import read_data

SETTINGS = ("task", "preset", "perturbation", "ranges", "set", "device")
"""Entries that are compared like the versions of software."""
LARGEST = 1e30  # number in a row; a stranger's file may hold integers that are no floats
Row = dict[str, Any]
Size = tuple[int, int]
"""Worlds, and control steps of a rollout."""


class Baseline:
    """The rows of an earlier benchmark.

    Attributes:
        notes: Lines on differences: settings, device, software, and sizes that the baseline lacks.
    """

    def __init__(self, file: Path, result: Row, sizes: list[Size]) -> None:
        """Read a file; a UserError if it is not a benchmark's, or of other sizes only.

        ``result`` is the new benchmark without its rows; ``sizes`` are those that it measures.
        """
        data = read_data(file, {*SETTINGS, "versions", "rows"}, "benchmark.py --json")
        try:
            rows = [row for row in data["rows"] if "error" not in row]
            self._rows: dict[Size, Row] = {(row["num_envs"], row["num_steps_per_env"]): row for row in rows}
            was = {name: data[name] for name in SETTINGS} | data["versions"]
        except (LookupError, TypeError, ValueError):
            raise UserError(f"'{file}' is not a file that benchmark.py --json has written") from None
        missing = [size for size in sizes if size not in self._rows]
        if len(missing) == len(sizes):
            raise UserError(f"--baseline '{file}' has {_texts(self._rows) or 'no sizes'}, not {_texts(sizes)}")
        self.notes = [f"it has no {_texts(missing)}"] if missing else []
        now = {name: result[name] for name in SETTINGS} | result["versions"]
        for name in {**was, **now}:
            if was.get(name) != now.get(name):
                self.notes.append(f"its {name} was {was.get(name)!r}, is {now.get(name)!r}")

    def compare(self, row: Row, names: Iterable[str]) -> list[tuple[str, float, float, float]]:
        """Return name, old number, new number and new / old of the numbers of both; empty if the size is missing."""
        old = self._rows.get((row["num_envs"], row.get("num_steps_per_env", 0)), {})
        both = [name for name in names if _is_positive(old.get(name)) and _is_positive(row.get(name))]
        return [(name, old[name], row[name], row[name] / old[name]) for name in both]


def _is_positive(value: Any) -> bool:
    """Return whether a value is a number of which there is a ratio."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < LARGEST


def _texts(sizes: Iterable[Size]) -> str:
    """Name sizes."""
    return ", ".join(f"{num_envs} worlds x {num_steps} steps" for num_envs, num_steps in sizes)
