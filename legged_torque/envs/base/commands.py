"""Commanded velocities."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
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
        low, span: Lowest command, and what is from there to the highest; likewise of headings. Shapes: (4,).
    """

    def __init__(self, cfg: LeggedRobotCfg, device: str) -> None:
        """Start with commands of 0; they will be drawn from ``cfg.commands.ranges``."""
        ranges = cfg.commands.ranges
        self.values = torch.zeros(cfg.env.num_envs, 3, device=device)
        self.headings = torch.zeros(cfg.env.num_envs, device=device)
        self._has_headings = cfg.commands.heading_command
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

    def follow_headings(self, base_quat: Tensor) -> None:
        """With ``commands.heading_command``, command the yaw rates that turn trunks to their headings.

        A rate is proportional to the angle that is left, within the range of yaw rates. Shape: (num_envs, 4).
        """
        if self._has_headings:
            left = torch.remainder(self.headings - yaw(base_quat) + math.pi, 2.0 * math.pi) - math.pi
            self.values[:, 2].copy_((HEADING_GAIN * left).clamp(self.low[2], self.low[2] + self.span[2]))
