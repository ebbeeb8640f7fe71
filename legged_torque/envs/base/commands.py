"""Commanded velocities."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.sim import kernels


class UniformCommands:
    """Draws commands uniformly.

    Attributes:
        values: Commanded v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame. Shape: (num_envs, 3).
        low, span: Lowest command, and what is from there to the highest. Shapes: (3,).
    """

    def __init__(self, cfg: LeggedRobotCfg, device: str) -> None:
        """Start with commands of 0; they will be drawn from ``cfg.commands.ranges``."""
        ranges = cfg.commands.ranges
        self.values = torch.zeros(cfg.env.num_envs, 3, device=device)
        limits = [ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw]
        low, high = torch.tensor(limits, dtype=torch.float32, device=device).unbind(dim=1)
        self.low, self.span = low.clone(), high - low
        self._from_settings = self.low.clone(), self.span.clone()

    def hold(self, command: tuple[float, float, float] | None) -> None:
        """Draw nothing but one command from now on; None draws from the settings' ranges again."""
        low, span = self._from_settings
        self.low.copy_(low if command is None else torch.tensor(command))
        self.span.copy_(span if command is None else torch.zeros(3))

    def resample(self, mask: Tensor) -> None:
        """Draw new commands in the worlds of ``mask``. Shape: (num_envs,), bool."""
        seeds = torch.empty_like(mask, dtype=torch.int32).random_()
        arrays = [wp.from_torch(array) for array in (mask, seeds, self.low, self.span, self.values)]
        wp.launch(kernels.draw_commands, len(mask), arrays, device=arrays[0].device)
