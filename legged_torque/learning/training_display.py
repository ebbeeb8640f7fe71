"""The display of a training: its progress, how well the policy walks, and whether its numbers are healthy."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from statistics import fmean
from typing import TYPE_CHECKING

from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.text import Text

from legged_torque.utils.display import LINE_EVERY, Display

if TYPE_CHECKING:
    from typing_extensions import Self

UNIT = "iteration"
LINE_AFTER_EVALUATION = 2.0  # seconds between two plain lines if there is a new evaluation
WALKING = 0.7  # tracking from which on a policy walks
TREND = 10  # evaluations with whose mean the last one is compared
CELLS = 12  # characters of the curve of the tracking
ENTRY = 36  # width of a name and its value in the panel [characters]
NAME = 16  # width of the name in that
OTHER_ROWS = 19  # of the panel besides reward terms, at most [rows]
_SHOWN = {
    "Train/mean_reward": ("reward", "{:.2f}"),
    "Train/mean_episode_length": ("episode length", "{:.1f} s"),
    "kl": ("KL", "{:.4f}"),
    "action_std": ("noise", "{:.2f}"),
    "learning_rate": ("learning rate", "{:.1e}"),
}
"""Numbers by their names in the logs or the learner's: their names and formats in the display."""
_BLOCKS = "▁▂▃▄▅▆▇█"
_EVALUATION = "Evaluation"
_ELSEWHERE = re.compile(rf"{_EVALUATION}_(\w+)/track_percentage")
_TRACKING = re.compile(r"; tracking (\d\.\d+) \(best ")


class TrainingDisplay(Display):
    """Shows a training: a panel on a terminal, elsewhere a line after an evaluation or every ten seconds."""

    def __init__(
        self,
        title: str,
        folder: str,
        total: int,
        done: int,
        steps_per_iteration: int,
        is_quiet: bool = False,
        clock: Callable[[], float] = time.monotonic,
        walks_after: int = 0,
    ) -> None:
        """Prepare to show iterations.

        Args:
            title: Of the panel.
            folder: Folder of the run.
            total: Iterations of the whole training.
            done: Iterations before this process.
            steps_per_iteration: Of all worlds.
            is_quiet: Whether nothing is shown.
            clock: Returns the time [s].
            walks_after: Steps of all worlds after which an A1 has walked with these settings; 0 if that is not known.
        """
        super().__init__(UNIT, total, done, stays=True, clock=clock)
        self._walks_after = walks_after
        self._title, self._folder, self._steps, self._is_quiet = title, folder, steps_per_iteration, is_quiet
        self._env_steps, self._numbers = 0, dict[str, float]()  # so far; of the last iteration
        self._terms = dict[str, float]()  # rewards of the episodes that ended last, per second
        self._measured, self._tracking = dict[str, float](), list[float]()  # of the last evaluations; of all of them
        self._bad = {"diverged worlds": 0, "skipped updates": 0}  # in this process

    def __enter__(self) -> Self:
        """Begin to show; the first line follows the first iteration."""
        if not self._is_quiet:
            super().__enter__()
            self._printed = -math.inf
        return self

    def add_iteration(self, done: int, steps: int, numbers: Mapping[str, float]) -> None:
        """Show the state after an iteration.

        Args:
            done: Iterations so far.
            steps: Steps of all worlds so far.
            numbers: Numbers by their names in the logs, and the learner's. Once an episode has ended,
                "Train/mean_reward" and "Train/mean_episode_length" [s] as well.
        """
        measured = {name: number for name, number in numbers.items() if name.startswith(_EVALUATION)}
        self.done, self._env_steps, self._numbers = done, steps, dict(numbers)
        self._measured = {**self._measured, **measured}
        terms = {name.partition("/")[2]: n for name, n in numbers.items() if name.startswith("Episode_Reward/")}
        self._terms = terms or self._terms
        if not math.isnan(tracking := numbers.get(f"{_EVALUATION}/track_percentage", math.nan)):
            self._tracking = [*self._tracking, tracking]
        new = (numbers.get("Health/diverged_worlds", 0.0), numbers.get("skipped_updates", 0.0))
        self._bad = {name: count + int(more) for (name, count), more in zip(self._bad.items(), new, strict=True)}
        if not self._is_quiet:
            self.show(LINE_AFTER_EVALUATION if measured else LINE_EVERY)

    def line(self) -> str:
        """Return the state in a line."""
        bad = {name: f"{count:,}" for name, count in self._bad.items() if count}
        return "; ".join([super().line(), *(f"{name} {text}" for name, text in (self._entries() | bad).items())])

    def view(self) -> RenderableType:
        """Return the panel."""
        entries: dict[str, str | Text] = {**self._entries()}
        if self._tracking:
            change = self._tracking[-1] - fmean(self._tracking[-1 - TREND : -1] or self._tracking)
            entries["trend"] = Text.assemble(f"{change:+.3f} ", (blocks(self._tracking), "green"))
        entries |= {name: Text(f"{count:,}", "yellow" if count else "") for name, count in self._bad.items()}
        cells = [Text.assemble((f"{name:<{NAME}}", "dim"), text) for name, text in entries.items()]
        curricula = {name.partition("/")[2]: f"{n:.3g}" for name, n in self._numbers.items() if "Curriculum/" in name}
        below: list[Text] = []
        if curricula:
            below.append(Text.assemble(("curricula: ", "dim"), ", ".join(map(" ".join, curricula.items()))))
        largest = sorted(self._terms, key=lambda name: -abs(self._terms[name]))
        shown = largest[: 2 * max(0, self._console.height - OTHER_ROWS)]  # two in a row, at worst
        if shown:
            texts = [f"{name} {self._terms[name]:.2g}" for name in shown]
            below.append(Text.assemble(("reward terms: ", "dim"), ", ".join(texts)))
        if self.warnings:
            below.append(Text(f"warnings: {len(self.warnings)}, last: {self.warnings[-1]}", "yellow"))
        below.append(Text.assemble(("run: ", "dim"), self._folder))
        content = Group(super().view(), Columns(cells, width=min(ENTRY, self.width - 4), column_first=True), *below)
        return Panel(content, title=Text(self._title, "bold"), title_align="left", border_style="dim")

    def _entries(self) -> dict[str, str]:
        """Return the state as names and values."""
        numbers, speed = self._numbers, self.bar.tasks[0].speed
        entries = {"steps": f"{self._env_steps:,}"}
        if speed is not None:
            entries["steps/s"] = f"{speed * self._steps:,.0f}"
            if self._walks_after and max(self._tracking, default=0.0) < WALKING:
                seconds = (self._walks_after - self._env_steps) / (speed * self._steps)
                if seconds > 0.0:
                    entries["an A1 walks"] = f"in about {seconds / 60:.0f} min"
                elif self._tracking:  # a resumed training may walk already
                    entries["walks"] = "later than an A1 did"
        entries |= {name: form.format(numbers[key]) for key, (name, form) in _SHOWN.items() if key in numbers}
        if self._tracking:
            entries["tracking"] = f"{self._tracking[-1]:.3f} (best {max(self._tracking):.3f})"
            if (falls := self._measured.get(f"{_EVALUATION}/falls_per_minute")) is not None:
                entries["falls"] = f"{falls:.1f} per minute"
        elsewhere = {_ELSEWHERE.fullmatch(name): number for name, number in self._measured.items()}
        return entries | {f"in {found[1]}": f"{number:.3f}" for found, number in elsewhere.items() if found}


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
