"""The weighted sum of reward terms. The terms themselves are methods ``_reward_<term>`` of the task."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from legged_torque.envs.base.curriculum import LinearCurriculum
from legged_torque.envs.base.legged_robot_config import LinearChange
from legged_torque.utils.errors import UserError


class Rewards:
    """Computes all terms, weighs them and sums them up.

    Attributes:
        names: Names of the terms.
        terms: Weighted terms of the last step. Shape: (terms, num_envs).
        episode_sums: Weighted sums of each term over the episode so far. Shape: (terms, num_envs).
        only_positive: Whether the sum is clipped at 0 from below.
    """

    def __init__(
        self,
        functions: Mapping[str, Callable[[], Tensor]],
        scales: Mapping[str, float],
        curricula: Mapping[str, LinearChange],
        only_positive: bool,
        dt: float,
        num_envs: int,
        device: str,
    ) -> None:
        """Prepare the weights: each term's scale per second, times its factor of the curricula, if it has one.

        ``functions`` return each term's values, one per world.
        """
        self.names = list(functions)
        self.terms, self.episode_sums = (torch.zeros(len(self.names), num_envs, device=device) for _ in range(2))
        self._functions, self._rows = list(functions.values()), self.terms.unbind()
        self.only_positive = only_positive
        self._scales = torch.tensor([scales[name] for name in self.names], dtype=torch.float32, device=device) * dt
        self._curriculum = LinearCurriculum([curricula.get(name) for name in self.names], device)

    def weights(self, total_steps: Tensor) -> Tensor:
        """Return the weights at a moment of training (scalar, int64). Shape: (terms,)."""
        return self._scales * self._curriculum(total_steps)

    def compute(self, total_steps: Tensor) -> Tensor:
        """Compute all terms and return their sum; ``total_steps`` are those of training so far. Shape: (num_envs,).

        A UserError if a term has another shape.
        """
        weights, total = self.weights(total_steps).unbind(), torch.zeros_like(self._rows[0])
        for name, weight, function, row in zip(self.names, weights, self._functions, self._rows, strict=True):
            values = function()
            if values.shape != row.shape:
                raise UserError(f"reward term '{name}' has the shape {tuple(values.shape)}, not {tuple(row.shape)}")
            weighted = weight * values
            row.copy_(weighted)  # row by row: a GPU makes one kernel of all
            total = total + weighted
        return total.clamp(min=0.0) if self.only_positive else total

    def add_to_episode(self, diverged: Tensor) -> None:
        """Add the terms to the sums of the episode, as 0 in worlds that have diverged. Shape: (num_envs,), bool."""
        self.terms.masked_fill_(diverged, 0.0)
        self.episode_sums += self.terms

    def state_dict(self) -> dict[str, Tensor]:
        """Return the terms and their sums."""
        return {"terms": self.terms, "episode_sums": self.episode_sums}
