"""The metrics of walking: their names, units and titles. Every table, figure and file follows this list."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    """How a metric is named and shown.

    Attributes:
        name: Its name in files and on the terminal.
        unit: Its unit; empty if it has none.
        title: Its name in tables and figures. The paper's own name, if the metric is in Table I.
        lower_is_better: Whether smaller values are better; None if neither direction is.
        in_paper: Whether Table I of the paper has it.
        digits: Decimals shown in tables; as many as the paper prints.
    """

    name: str
    unit: str
    title: str
    lower_is_better: bool | None
    in_paper: bool = False
    digits: int = 4

    @property
    def label(self) -> str:
        """The title with the unit."""
        return f"{self.title} [{self.unit.replace('^2', '²')}]" if self.unit else self.title


METRICS = (
    Metric("track_percentage", "", "Track % [share]", False, in_paper=True),  # the paper prints 0.76, not 76
    Metric("track_xy", "m^2/s^2", "Track xy", True, in_paper=True),
    Metric("track_angular", "rad^2/s^2", "Track angular", True, in_paper=True),
    Metric("collision_force", "N", "Collision forces", True, in_paper=True, digits=1),
    Metric("cost_of_transport", "", "Cost of transport", True, in_paper=True),
    Metric("height", "m", "Walking height", None),
    Metric("speed", "m/s", "Speed", None),
    Metric("falls_per_minute", "1/min", "Falls per minute", True),
)
"""The metrics of an evaluation, the five of the paper first. To add one, add its line here and its formula to
:mod:`legged_torque.utils.metrics`."""
