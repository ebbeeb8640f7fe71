"""Settings of values that change while a policy learns: sections with a method ``scale_steps``."""

from legged_torque.utils.config import Section, section_keys
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import Number


class LinearChange(Section):
    """A value that changes linearly with the total number of environment steps (paper, eq. 1)."""

    start: float = 1.0  # value up to t_start
    end: float = 1.0  # value from t_end on
    t_start: Number = 0  # [total steps]
    t_end: Number = 1  # [total steps]

    def check(self, path: str = "") -> None:
        """Refuse values that are not allowed, and a change backwards in time."""
        super().check(path)
        if self.t_start > self.t_end:
            raise UserError(f"{path}.t_start must be at most its t_end, {self.t_end}, not {self.t_start}")

    def scale_steps(self, factor: float) -> None:
        """Begin and end after ``factor`` times the steps."""
        self.t_start, self.t_end = round(factor * self.t_start), round(factor * self.t_end)


def scale_changes(settings: Section, factor: float) -> None:
    """Let all changes within settings take ``factor`` times their steps."""
    for section in (getattr(settings, key) for key in section_keys(settings)):
        if hasattr(section, "scale_steps"):
            section.scale_steps(factor)
        elif isinstance(section, Section):
            scale_changes(section, factor)
