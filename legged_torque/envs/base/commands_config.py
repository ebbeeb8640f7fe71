"""Settings of commands. They need no torch."""

from __future__ import annotations

import pkgutil
from collections.abc import Sequence
from typing import Annotated, Any

from legged_torque.utils.config import Section
from legged_torque.utils.limits import Fraction, Interval, Limits, NotNegative, Share


class CommandsCfg(Section):
    """Commanded velocities, in the trunk's frame. A generator of your own is what an overridden ``build`` returns."""

    resampling_probability: Share = 0.002  # per control step: about every 10 s at 50 Hz
    heading_command: bool = False  # whether headings are drawn, and yaw rates are what turns to them
    fixed: Annotated[list[float], Limits(length=3)] | None = None  # v_x, v_y, yaw rate of all worlds; None: drawn
    standing_share: Share = 0.0  # of draws that are commands to stand
    zero_below: NotNegative = 0.0  # [m/s] slower v_x, v_y are drawn as 0, yaw rates stay; 0.2 in legged_gym
    curriculum: bool = False  # whether ranges start narrow, and grow while robots track them well
    curriculum_start: Fraction = 0.2  # share of the ranges with which they start

    class ranges:  # drawn uniformly
        lin_vel_x: Interval = [-1.0, 1.0]  # [m/s]
        lin_vel_y: Interval = [-1.0, 1.0]  # [m/s]
        ang_vel_yaw: Interval = [-1.0, 1.0]  # [rad/s]; the limits of what turns to headings
        heading: Annotated[list[float], Limits(-3.14160, 3.14160, ordered=True)] = [-3.14159, 3.14159]  # [rad]

    def fix(self, command: Sequence[float]) -> None:
        """Leave nothing but one command: v_x, v_y [m/s] and a yaw rate [rad/s]."""
        ranges, self.fixed = self.ranges, list(command)
        ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw = ([value, value] for value in command)

    def build(self, task: Any) -> Any:
        """Return the :class:`~legged_torque.envs.base.commands.UniformCommands` of a task, or a class of that kind."""
        return pkgutil.resolve_name("legged_torque.envs.base.commands:UniformCommands")(self, task)
