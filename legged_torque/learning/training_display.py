"""What a training shows while it runs: how far it is, how well the policy walks, whether its numbers are healthy."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, zip_longest
from statistics import fmean
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from legged_torque.utils.display import LINE_EVERY, Display, Pace, bar, progress_text

if TYPE_CHECKING:
    from typing_extensions import Self

WHAT = "iteration"
LINE_AFTER_EVALUATION = 2.0  # seconds between two plain lines if there is a new evaluation
TREND = 10  # evaluations with whose mean the last one is compared
CELLS = 12  # characters of the curve of the tracking
NAMES = 15  # width of names [characters]
TWO_COLUMNS = 76  # width of the panel from which on numbers stand in two columns [characters]
_BLOCKS = "▁▂▃▄▅▆▇█"
_CURRICULUM, _EVALUATION = "Curriculum/", "Evaluation"
_TRACK, _FALLS = f"{_EVALUATION}/track_percentage", f"{_EVALUATION}/falls_per_minute"
_ELSEWHERE = re.compile(rf"{_EVALUATION}_(\w+)/track_percentage")
_TRACKING = re.compile(r"; tracking (\d\.\d+) \(best ")

Column = list[tuple[str, str | Text]]
"""Names and values, below each other."""


@dataclass(frozen=True)
class State:
    """What is known of a training after an iteration."""

    steps: int = 0  # of all worlds
    numbers: Mapping[str, float] = field(default_factory=dict)  # of the last iteration, by their names in the logs
    measured: Mapping[str, float] = field(default_factory=dict)  # the last evaluations, likewise
    tracking: tuple[float, ...] = ()  # of the evaluations in this process
    diverged: int = 0  # worlds, in this process
    skipped: int = 0  # updates, in this process


class TrainingDisplay(Display):
    """Shows a training: a panel on a terminal, elsewhere a line after an evaluation or every ten seconds."""

    def __init__(self, title: str, folder: str, pace: Pace, steps_per_iteration: int, is_quiet: bool) -> None:
        """Prepare; ``folder`` is that of the run, and ``pace`` counts iterations. A quiet display shows nothing."""
        super().__init__(stays=True)
        self._title, self._folder, self._pace, self._steps = title, folder, pace, steps_per_iteration
        self._is_quiet, self._state = is_quiet, State()

    def __enter__(self) -> Self:
        """Begin to show; the first line follows the first iteration."""
        if not self._is_quiet:
            super().__enter__()
            self._printed = -math.inf
        return self

    def add_iteration(self, done: int, steps: int, numbers: Mapping[str, float]) -> None:
        """Show the state after an iteration: how many are done, steps so far, and numbers by their names in the logs.

        Besides those there are "kl", "skipped_updates", "noise" and "learning_rate", and, once an episode has ended,
        "reward" and "length" [s].
        """
        old, now = self._state, numbers.get(_TRACK, math.nan)
        measured = {name: number for name, number in numbers.items() if name.startswith(_EVALUATION)}
        self._pace.add(done)
        self._state = State(
            steps,
            numbers,
            {**old.measured, **measured},
            old.tracking if math.isnan(now) else (*old.tracking, now),
            old.diverged + int(numbers.get("Health/diverged_worlds", 0.0)),
            old.skipped + int(numbers["skipped_updates"]),
        )
        if not self._is_quiet:
            self.update(LINE_AFTER_EVALUATION if measured else LINE_EVERY)

    def line(self) -> str:
        """Return the state in a line."""
        state, numbers = self._state, self._state.numbers
        parts = [progress_text(WHAT, self._pace, time.monotonic() - self.start)]
        parts.append(", ".join(filter(None, (f"{state.steps:,} steps", self._speed()))))
        if "reward" in numbers:
            parts.append(f"reward {numbers['reward']:.2f}, episodes {numbers['length']:.1f} s")
        if state.tracking:
            tracking = f"tracking {state.tracking[-1]:.3f} (best {max(state.tracking):.3f})"
            parts.append(f"{tracking}, {state.measured[_FALLS]:.1f} falls/min")
        parts.append(", ".join(f"{name} {text}" for name, text in updates(numbers)))
        bad = {"diverged worlds": state.diverged, "skipped updates": state.skipped}
        return "; ".join([*parts, *(f"{count} {name}" for name, count in bad.items() if count)])

    def picture(self) -> RenderableType:
        """Return the panel."""
        columns = [self._of_training(), self._of_evaluations()]
        if self.width < TWO_COLUMNS:
            tables = [table([[*columns[1], *columns[0], *self._of_run()]])]
        else:
            tables = [table(columns), table([self._of_run()])]
        notices = [Text(text, "bold yellow") for text in (self.activity, self.notice) if text]
        seconds, left = time.monotonic() - self.start, self._pace.left()
        progress = bar(f"{WHAT} {self._pace}", self._pace.share, seconds, left)
        content = Group(progress, *notices, *tables)  # the end is cut off where a terminal is low
        return Panel(content, title=Text(self._title, "bold"), title_align="left", border_style="dim")

    def _speed(self) -> str:
        """Return the steps per second; empty if they are not known yet."""
        rate = self._pace.per_second()
        return "" if rate is None else f"{rate * self._steps:,.0f} steps/s"

    def _of_training(self) -> Column:
        """Return what the training itself tells."""
        state, numbers = self._state, self._state.numbers
        column: Column = [("steps", f"{state.steps:,}"), ("speed", self._speed())]
        if "reward" in numbers:
            column += [("reward", f"{numbers['reward']:.2f}"), ("episode length", f"{numbers['length']:.1f} s")]
        else:
            column.append(("reward", "no episode has ended"))
        return column + updates(numbers)

    def _of_evaluations(self) -> Column:
        """Return what was measured last, and whether numbers were bad."""
        state, column = self._state, Column()
        if state.tracking:
            now, before = state.tracking[-1], state.tracking[-1 - TREND : -1] or state.tracking
            column.append(("tracking", Text.assemble((f"{now:.3f}", "bold"), f", best {max(state.tracking):.3f}")))
            column.append(("trend", Text.assemble(f"{now - fmean(before):+.3f} ", (blocks(state.tracking), "green"))))
            column.append(("falls", f"{state.measured[_FALLS]:.1f} per minute"))
        else:
            column.append(("tracking", "not measured yet"))
        for name, number in state.measured.items():
            environment = _ELSEWHERE.fullmatch(name)
            if environment:
                column.append((f"in {environment[1]}", f"{number:.3f}"))
        for name, count in {"diverged worlds": state.diverged, "skipped updates": state.skipped}.items():
            column.append((name, Text(f"{count:,}", "yellow" if count else "")))
        return column

    def _of_run(self) -> Column:
        """Return what may take a whole line: curricula, warnings, and where the run is."""
        numbers, column = self._state.numbers.items(), Column()
        curricula = [f"{name[len(_CURRICULUM) :]} {number:.3g}" for name, number in numbers if _CURRICULUM in name]
        if curricula:
            column.append(("curricula", Text(", ".join(curricula), no_wrap=False)))
        if self.warnings:
            text = f"{len(self.warnings)}, last: {self.warnings[-1]}"
            column.append(("warnings", Text(text, "yellow", no_wrap=False)))
        room = self.width - NAMES - 8  # beside borders and gaps
        folder = self._folder if len(self._folder) <= room else f"...{self._folder[3 - room :]}"
        return [*column, ("run", folder)]


def updates(numbers: Mapping[str, float]) -> Column:
    """Return what tells of the updates."""
    formats = {"kl": ("KL", ".4f"), "noise": ("noise", ".2f"), "learning_rate": ("learning rate", ".1e")}
    return [(name, f"{numbers[key]:{style}}") for key, (name, style) in formats.items() if key in numbers]


def table(columns: Sequence[Column]) -> Table:
    """Return columns side by side; lines that do not fit are cut off, unless they may wrap."""
    grid = Table.grid(padding=(0, 2), expand=True)
    for _ in columns:
        grid.add_column(style="dim", no_wrap=True, width=NAMES)
        grid.add_column(no_wrap=True, overflow="ellipsis", ratio=1)
    for cells in zip_longest(*columns, fillvalue=("", "")):
        grid.add_row(*(part for cell in cells for part in cell))
    return grid


def blocks(values: Sequence[float]) -> str:
    """Return a curve of at most :data:`CELLS` characters, from the lowest to the highest of some values."""
    count = min(len(values), CELLS)
    means = [fmean(values[start:end]) for start, end in pairwise(len(values) * i // count for i in range(count + 1))]
    low, high = min(means), max(means)
    scale = (len(_BLOCKS) - 1) / max(high - low, 1e-9)
    return "".join(_BLOCKS[round((mean - low) * scale)] for mean in means)


def read_tracking(text: str) -> str:
    """Return the tracking of the last :meth:`TrainingDisplay.line` in a text; "" if there is none."""
    found = _TRACKING.findall(text)
    return found[-1] if found else ""
