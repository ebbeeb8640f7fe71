"""What an experiment shows on a terminal while it runs: how many cells are done, and how far each running step is."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import astuple, dataclass

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from legged_torque.utils.display import Display, bar


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
        super().__init__()
        self._title = title
        self._state: tuple[str, float, float | None, Sequence[Row]] = ("", 0.0, None, ())

    def show(self, text: str, share: float, left: float | None, rows: Sequence[Row]) -> None:
        """Show how far all is, in words and as a share, the time left [s], None if unknown, and what runs."""
        self._state = text, share, left, rows
        self.update(line_every=math.inf)

    def picture(self) -> RenderableType:
        """Return the panel."""
        text, share, left, rows = self._state
        grid = Table(box=None, padding=(0, 2, 0, 0), expand=True, header_style="dim")
        grid.add_column("running", no_wrap=True, overflow="ellipsis", ratio=1)
        for name in ("device", "step", "tracking", "left"):
            grid.add_column(name, no_wrap=True)
        for row in rows:
            grid.add_row(*astuple(row))
        content = Group(bar(text, share, time.monotonic() - self.start, left), grid)
        return Panel(content, title=Text(self._title, "bold"), title_align="left", border_style="dim")
