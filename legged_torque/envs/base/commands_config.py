"""Settings of commands. They need no torch."""

import pkgutil
from collections.abc import Sequence
from typing import Annotated, Any

from legged_torque.utils.config import Section
from legged_torque.utils.limits import Fraction, Interval, Limits, NotNegative, Share


class CommandsCfg(Section):
    """Commanded velocities, in the trunk's frame. Override ``build`` to use a generator of your own."""

    resampling_probability: Share = 0.002  # per control step: about every 10 s at 50 Hz
    heading_command: bool = False  # whether headings are drawn, and yaw rates are what turns to them
    fixed: Annotated[list[float], Limits(length=3)] | None = None  # v_x, v_y, yaw rate of all worlds; None: drawn
    standing_share: Share = 0.0  # share of draws that command a robot to stand
    zero_below: NotNegative = 0.0  # [m/s] drawn v_x, v_y of a lower speed become 0; legged_gym has 0.2
    curriculum: bool = False  # whether ranges start narrow, and grow while robots track them well
    curriculum_start: Fraction = 0.2  # share of the ranges with which they start

    class ranges:  # drawn uniformly
        lin_vel_x: Interval = [-1.0, 1.0]  # [m/s]
        lin_vel_y: Interval = [-1.0, 1.0]  # [m/s]
        ang_vel_yaw: Interval = [-1.0, 1.0]  # [rad/s]; the limits of what turns to headings
        heading: Annotated[list[float], Limits(-3.14160, 3.14160, ordered=True)] = [-3.14159, 3.14159]  # [rad]

    def fix(self, command: Sequence[float]) -> None:
        """Allow one command only: v_x, v_y [m/s] and a yaw rate [rad/s]."""
        ranges, self.fixed = self.ranges, list(command)
        ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw = ([value, value] for value in command)

    def allowed(self) -> dict[str, list[float]]:
        """Return lowest and highest v_x, v_y [m/s] and yaw rate [rad/s] by name: of the ranges, or the one command."""
        ranges = {name: list(getattr(self.ranges, name)) for name in ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")}
        return ranges if self.fixed is None else dict(zip(ranges, ([v, v] for v in self.fixed), strict=True))

    def has_headings(self) -> bool:
        """Return whether yaw rates turn to headings."""
        return self.heading_command and self.fixed is None

    def build(self, task: Any) -> Any:
        """Return the :class:`~legged_torque.envs.base.commands.UniformCommands` of a task, or one derived from it."""
        return pkgutil.resolve_name("legged_torque.envs.base.commands:UniformCommands")(self, task)
