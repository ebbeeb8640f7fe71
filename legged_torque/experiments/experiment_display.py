"""The display of an experiment on a terminal: how many cells are done, and how far each running step is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress import Task
from rich.table import Table
from rich.text import Text

from legged_torque.utils import display
from legged_torque.utils.display import Display


@dataclass(frozen=True)
class Row:
    """A step that runs."""

    cell: str
    device: str  # empty while it waits for a machine
    step: str  # what it does, and how far it is
    tracking: str  # of the last evaluation; empty if there was none
    left: str  # time that the step takes still; empty if unknown


class ExperimentDisplay(Display):
    """Shows a panel on a terminal; elsewhere nothing, as each step that ends is a line already."""

    def __init__(self, title: str) -> None:
        """Prepare to show an experiment that is called so."""
        super().__init__("", 1)
        self._title, self._updated = title, -math.inf
        self._state: tuple[str, float, float | None, Sequence[Row]] = ("", 0.0, None, ())

    def is_due(self) -> bool:
        """Return whether there is a panel whose state is to be set anew."""
        return self._live is not None and self._clock() - self._updated >= display.REDRAW_EVERY

    def set_state(self, text: str, share: float, left: float | None, rows: Sequence[Row]) -> None:
        """Set how far all is, in words and as a share, the time left [s], None if unknown, and the steps that run."""
        self._state, self._updated = (text, share, left, rows), self._clock()

    def update_bar(self) -> Task:
        """Update the bar, and return its task."""
        text, share, left, _ = self._state
        self.bar.update(self._id, completed=share, description=text, left=left)
        return self.bar.tasks[0]

    def view(self) -> RenderableType:
        """Return the panel."""
        grid = Table(box=None, padding=(0, 2, 0, 0), expand=True, header_style="dim")
        grid.add_column("running", no_wrap=True, overflow="ellipsis", ratio=1)
        for name in ("device", "step", "tracking", "left"):
            grid.add_column(name, no_wrap=True)
        for row in self._state[3]:
            grid.add_row(*astuple(row))
        content = Group(super().view(), grid)
        return Panel(content, title=Text(self._title, "bold"), title_align="left", border_style="dim")
