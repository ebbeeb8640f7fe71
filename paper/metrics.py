"""The metrics of evaluations in tables and figures: titles, units, and which direction is better."""

from dataclasses import dataclass

from legged_torque.utils.metrics import UNITS


@dataclass(frozen=True)
class Metric:
    """Presentation of a metric."""

    name: str  # in files and on the terminal
    title: str  # its name in tables and figures; the paper's own name, if the metric is in Table I
    lower_is_better: bool | None  # None if neither direction is better
    digits: int = 4  # decimals shown in tables; as many as the paper prints

    @property
    def label(self) -> str:
        """The title with the unit."""
        unit = UNITS.get(self.name, "").replace("^2", "²")
        return f"{self.title} [{unit}]" if unit else self.title

    def gain(self, value: float, other: float) -> float:
        """Return by how much a value is better than another one; negative if it is worse."""
        if self.lower_is_better is None:
            raise ValueError(f"neither direction of {self.name} is better")
        return other - value if self.lower_is_better else value - other


PAPER_METRICS = (
    Metric("track_percentage", "Tracking", False),  # the paper's "Track %", which it prints as 0.76
    Metric("track_xy", "Track xy", True),
    Metric("track_angular", "Track angular", True),
    Metric("collision_force", "Collision forces", None, digits=1),  # the weight and a little more, however it walks
    Metric("cost_of_transport", "Cost of transport", True),
)
"""The metrics of Table I of the paper, in its order."""
COMPARED = tuple(metric for metric in PAPER_METRICS if metric.lower_is_better is not None)
"""Those that say who is better."""
METRICS = (
    *PAPER_METRICS,
    Metric("height", "Walking height", None),
    Metric("speed", "Speed", None),
    Metric("falls_per_minute", "Falls per minute", True),
)
"""The metrics of an evaluation."""
