"""Commanded velocities."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.state import RobotState
from legged_torque.sim import kernels
from legged_torque.utils.math import yaw

HEADING_GAIN = 0.5
"""Commanded yaw rate per angle that is left to a heading [1/s], as in legged_gym."""


def fix_command(cfg: LeggedRobotCfg, command: Sequence[float]) -> None:
    """Let a task with these settings draw nothing but one command: v_x, v_y [m/s] and a yaw rate [rad/s]."""
    ranges = cfg.commands.ranges
    ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw = ([value, value] for value in command)


class UniformCommands:
    """Draws commands uniformly.

    Attributes:
        values: Commanded v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame. Shape: (num_envs, 3).
        headings: Where trunks shall turn to with ``commands.heading_command`` [rad]. Shape: (num_envs,).
        low, span: Lowest v_x, v_y, yaw rate and heading, and the widths of their ranges. Shapes: (4,).
    """

    def __init__(self, settings: type[LeggedRobotCfg.commands], state: RobotState) -> None:
        """Start with commands of 0; they will be drawn from ``commands.ranges`` into those of the state."""
        ranges, device = settings.ranges, state.device
        self.values, self._base_quat = state.commands, state.base_quat
        self.headings = torch.zeros(state.num_envs, device=device)
        self._has_headings = settings.heading_command
        limits = [ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw, ranges.heading]
        low, high = torch.tensor(limits, dtype=torch.float32, device=device).unbind(dim=1)
        self.low, self.span = low.clone(), high - low
        self._from_settings = self.low.clone(), self.span.clone()

    def hold(self, command: tuple[float, float, float] | None) -> None:
        """Draw nothing but one command from now on; None draws from the settings' ranges again."""
        low, span = self._from_settings
        self.low.copy_(low if command is None else torch.tensor((*command, 0.0)))
        self.span.copy_(span if command is None else torch.zeros(4))

    def resample(self, mask: Tensor) -> None:
        """Draw new commands in the worlds of ``mask``. Shape: (num_envs,), bool."""
        seeds = torch.empty_like(mask, dtype=torch.int32).random_()
        arrays = [wp.from_torch(array) for array in (mask, seeds, self.low, self.span, self.values, self.headings)]
        wp.launch(kernels.draw_commands, len(mask), arrays, device=arrays[0].device)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the headings; the commands are a part of the state."""
        return {"headings": self.headings}

    def follow_headings(self) -> None:
        """With ``commands.heading_command``, command the yaw rates that turn trunks to their headings.

        A rate is proportional to the angle that is left, within the range of yaw rates.
        """
        if self._has_headings:
            left = torch.remainder(self.headings - yaw(self._base_quat) + math.pi, 2.0 * math.pi) - math.pi
            self.values[:, 2].copy_((HEADING_GAIN * left).clamp(self.low[2], self.low[2] + self.span[2]))
