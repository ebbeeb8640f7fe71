"""The weighted sum of reward terms. The terms themselves are methods ``_reward_<term>`` of the task."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from legged_torque.envs.base.curriculum import LinearCurriculum
from legged_torque.utils.buffers import check_tensor
from legged_torque.utils.config import section_keys, to_dict
from legged_torque.utils.errors import check_names


class Rewards:
    """Computes all terms, weighs them and sums them up.

    Attributes:
        names: Names of the terms.
        terms: Weighted terms of the last step. Shape: (terms, num_envs).
        episode_sums: Weighted sums of each term over the episode so far. Shape: (terms, num_envs).
        only_positive: Whether the sum is clipped at 0 from below.
    """

    def __init__(
        self, functions: Mapping[str, Callable[[], Tensor]], settings: Any, dt: float, num_envs: int, device: str
    ) -> None:
        """Prepare the terms with a scale that is not zero.

        Their weights are the scales per second of the section ``rewards``, times a factor of its curricula, if they
        have one. ``functions`` return the values of all known terms, one per world. A UserError for an unknown term.
        """
        scales = {name: scale for name, scale in to_dict(settings.scales).items() if scale != 0.0}
        curricula = {name: getattr(settings.curriculum, name) for name in section_keys(settings.curriculum)}
        check_names("reward term", [*scales, *curricula], functions)
        self.names = list(scales)
        self.terms, self.episode_sums = (torch.zeros(len(self.names), num_envs, device=device) for _ in range(2))
        self._functions, self._rows = [functions[name] for name in self.names], self.terms.unbind()
        self.only_positive = settings.only_positive_rewards
        self._scales = torch.tensor(list(scales.values()), dtype=torch.float32, device=device) * dt
        self._curriculum = LinearCurriculum([curricula.get(name) for name in self.names], device)

    def weights(self, total_steps: Tensor) -> Tensor:
        """Return the weights at a moment of training (scalar, int64). Shape: (terms,)."""
        return self._scales * self._curriculum(total_steps)

    def compute(self, total_steps: Tensor) -> Tensor:
        """Compute all terms and return their sum; ``total_steps`` are those of training so far. Shape: (num_envs,).

        A UserError if a term is no tensor of that shape.
        """
        weights, total = self.weights(total_steps).unbind(), torch.zeros_like(self._rows[0])
        for name, weight, function, row in zip(self.names, weights, self._functions, self._rows, strict=True):
            values = function()
            check_tensor(f"reward term '{name}'", values, row.shape, row.device)
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
