"""The distribution of actions."""

import torch
from rsl_rl.modules import distribution
from torch import Tensor


class GaussianDistribution(distribution.GaussianDistribution):
    """rsl_rl's Gaussian, sampled without ``torch.normal``, which waits for the host to see that no deviation is < 0.

    Attributes:
        weights: Weights of the actions in the entropy. Shape: (output_dim,); None: 1.
    """

    weights: Tensor | None = None

    @property
    def entropy(self) -> Tensor:
        """Return the weighted sum of the actions' entropies. Shape: (...)."""
        entropies = self._distribution.entropy()
        return (entropies if self.weights is None else self.weights * entropies).sum(dim=-1)

    def sample(self) -> Tensor:
        """Return a sample. Shape: (..., output_dim)."""
        return (self.mean + self.std * torch.randn_like(self.mean)).detach()
