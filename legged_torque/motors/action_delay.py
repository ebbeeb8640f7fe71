"""The time that actions take from the policy to the motors."""

from __future__ import annotations

import math

import torch
import warp as wp
from torch import Tensor

UNITS = ("physics_steps", "control_steps")  # what ``domain_rand.action_delay`` may count


@wp.struct
class Delay:
    """What the physics kernel reads of an :class:`ActionDelay`, see its attributes."""

    newest: wp.array2d[float]
    before: wp.array3d[float]
    drawn: wp.array2d[float]
    physics_steps: int
    decimation: int
    depth: int


@wp.func
def age_of_actions(delay: Delay, world: int, physics_step: int) -> int:
    """Return how many control steps ago a world was sent the actions that have reached its motors."""
    missing = int(wp.clamp(delay.drawn[world, 0], 0.0, 1.0e4)) * delay.physics_steps - physics_step
    return wp.clamp((missing + delay.decimation - 1) // delay.decimation, 0, delay.depth)


class ActionDelay:
    """Holds actions back, in each world for a time of its own that is drawn at every reset."""

    def __init__(self, newest: Tensor, longest: int, unit: str, decimation: int) -> None:
        """Prepare; no delay until one is drawn, up to ``longest`` in a unit of :data:`UNITS`."""
        self.decimation = decimation  # physics steps of a control step
        self.physics_steps = decimation if unit == "control_steps" else 1  # of the unit
        self.newest = newest  # buffer of the newest actions, written elsewhere. Shape: (num_envs, num_actions)
        self.depth = math.ceil(longest * self.physics_steps / decimation)  # older actions that are kept
        # Older ones, the newest first. Shape: (num_envs, control steps, num_actions).
        self.before = newest.new_zeros(len(newest), self.depth, newest.shape[1])
        self.drawn = newest.new_zeros(len(newest), 1)  # in the unit; its whole part counts. Shape: (num_envs, 1)

    def keep(self) -> None:
        """Keep the newest actions, before they are overwritten."""
        if self.depth:
            self.before.copy_(torch.cat([self.newest.unsqueeze(1), self.before[:, :-1]], dim=1))

    def reset(self, mask: Tensor) -> None:
        """Forget the actions of the worlds in ``mask``. Shape: (num_envs,), bool."""
        self.before.masked_fill_(mask.view(-1, 1, 1), 0.0)

    def actions(self, physics_step: int) -> Tensor:
        """Return the actions that have reached the motors by this physics step. Shape: (num_envs, num_actions)."""
        if not self.depth:
            return self.newest
        missing = self.drawn.floor() * self.physics_steps - physics_step
        age = (missing / self.decimation).ceil().long().clamp(0, self.depth)  # NaN becomes any number
        history = torch.cat([self.newest.unsqueeze(1), self.before], dim=1)
        return history.gather(1, age.unsqueeze(2).expand(-1, 1, self.newest.shape[1])).squeeze(1)
