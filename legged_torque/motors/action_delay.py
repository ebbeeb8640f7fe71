"""The time that actions take from the policy to the motors."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot

UNITS = ("physics_steps", "control_steps")
"""What ``domain_rand.action_delay`` may count."""


class ActionDelay:
    """Holds actions back, in each world for a time of its own that is drawn at every reset.

    Attributes:
        drawn: Delay in the unit of the settings; its whole part counts. Shape: (num_envs, 1).
    """

    def __init__(self, task: LeggedRobot) -> None:
        """Prepare; there is no delay until one is drawn.

        Args:
            task: The task, whose ``actions`` are the newest ones.
        """
        rand = task.cfg.domain_rand
        self._decimation = task.cfg.control.decimation
        self._physics_steps = self._decimation if rand.action_delay_unit == "control_steps" else 1
        self._newest = task.actions
        depth = math.ceil(rand.action_delay[1] * self._physics_steps / self._decimation)
        self._before = task.actions.new_zeros(depth, *task.actions.shape)
        self.drawn = task.actions.new_zeros(task.num_envs, 1)

    def keep(self) -> None:
        """Keep the newest actions, before they are overwritten."""
        if len(self._before):
            self._before.copy_(torch.cat([self._newest.unsqueeze(0), self._before[:-1]]))

    def reset(self, mask: Tensor) -> None:
        """Forget the actions of the worlds in ``mask``. Shape: (num_envs,), bool."""
        if len(self._before):
            self._before.masked_fill_(mask.view(1, -1, 1), 0.0)

    def actions(self, physics_step: int) -> Tensor:
        """Return the actions that have reached the motors.

        Args:
            physics_step: Number of the physics step within the control step.

        Returns:
            Shape: (num_envs, num_actions).
        """
        if not len(self._before):
            return self._newest
        missing = self.drawn.floor() * self._physics_steps - physics_step
        age = (missing / self._decimation).ceil().long()
        history = torch.cat([self._newest.unsqueeze(0), self._before])
        return history.gather(0, age.unsqueeze(0).expand(1, *self._newest.shape)).squeeze(0)
