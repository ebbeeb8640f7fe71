"""The distribution of actions."""

import torch
from rsl_rl.modules import distribution
from torch import Tensor


class GaussianDistribution(distribution.GaussianDistribution):
    """rsl_rl's Gaussian, sampled without ``torch.normal``, which waits for the host to see that no deviation is < 0."""

    def sample(self) -> Tensor:
        """Return a sample. Shape: (..., output_dim)."""
        return (self.mean + self.std * torch.randn_like(self.mean)).detach()
