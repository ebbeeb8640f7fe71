"""Noise that is repeated for some steps, so that exploration goes somewhere."""

import torch
from torch import Tensor


class RepeatedNoise:
    """Standard normal numbers that all worlds repeat for the same random number of steps.

    The number n of steps has a probability in proportion to n^-mu, up to a largest one (arXiv 2604.04539).

    Attributes:
        values: The present numbers. Shape: (num_envs, num_actions).
        left: Steps for which they are still to be used. Scalar, int64.
    """

    def __init__(self, num_envs: int, num_actions: int, mu: float, most_steps: int, device: str) -> None:
        """Prepare; the first step draws."""
        self.values = torch.zeros(num_envs, num_actions, device=device)
        self.left = torch.zeros((), dtype=torch.long, device=device)
        weights = torch.arange(1, most_steps + 1, device=device, dtype=torch.float64) ** -mu
        self._below = (weights / weights.sum()).cumsum(0)[:-1]

    def next(self) -> Tensor:
        """Return the numbers of a step, which the next call overwrites; nothing waits for the host."""
        is_over = self.left == 0
        draws, share = torch.randn_like(self.values), torch.rand((), dtype=torch.float64, device=self.left.device)
        self.values.copy_(torch.where(is_over, draws, self.values))
        self.left.copy_(torch.where(is_over, 1 + (share >= self._below).sum(), self.left) - 1)
        return self.values

    def tensors(self) -> dict[str, Tensor]:
        """Return what it keeps from step to step."""
        return {"values": self.values, "left": self.left}
