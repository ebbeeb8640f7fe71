"""What transitions are worth: the scale of rewards, and the distribution that a critic is to have."""

import torch
from torch import Tensor, nn


class RewardScale(nn.Module):
    """Scales rewards so that returns have a standard deviation of 1 and stay within the values of the critic.

    As published (arXiv 2604.04539): a reward is divided by the larger of the
    standard deviation of all discounted returns so far and their largest absolute value over ``largest``. Unlike the
    published code, the return of an episode starts at 0, without a part of the one before.
    """

    largest_return: Tensor
    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, gamma: float, largest: float) -> None:
        """Start from no returns."""
        super().__init__()
        self.gamma, self.largest = gamma, largest
        for name, value in {"largest_return": 0.0, "mean": 0.0, "var": 1.0, "count": 0.0}.items():
            self.register_buffer(name, torch.tensor(value, dtype=torch.float64))

    def follow(self, returns: Tensor, rewards: Tensor, dones: Tensor) -> None:
        """Let statistics and ``returns``, those so far of the present episodes, follow a step. Shapes: (num_envs,)."""
        returns.mul_(self.gamma).add_(torch.where(rewards.isfinite(), rewards, 0.0))  # NaN would stay for good
        self.largest_return.copy_(torch.maximum(self.largest_return, returns.abs().max()))
        var, mean = torch.var_mean(returns.double(), correction=0)
        share = len(returns) / (self.count + len(returns))
        delta = mean - self.mean
        self.var.add_(share * (var - self.var + (1.0 - share) * delta.square()))
        self.mean.add_(share * delta)
        self.count.add_(len(returns))
        returns.masked_fill_(dones, 0.0)

    def scale(self) -> Tensor:
        """Return what rewards are divided by. Scalar."""
        return torch.maximum((self.var + 1e-8).sqrt(), self.largest_return / self.largest).float()


def projected(probs: Tensor, places: Tensor, values: Tensor) -> Tensor:
    """Return the distribution over ``values`` that is nearest to one over other ``places``, of the same mean.

    The probability of a place goes to the two nearest values in proportion (C51, arXiv 1707.06887, equation 7); places
    outside of all values count as the outermost ones. Without atomic sums, so that it gives the same bits every time.

    Args:
        probs: Probabilities. Shape: (samples, num_places).
        places: Where they are. Shape: (samples, num_places).
        values: Equally spaced, ascending. Shape: (num_bins,).
    """
    bins = torch.arange(len(values), device=values.device)
    at = (places.clamp(values[0], values[-1]) - values[0]) * ((len(values) - 1) / (values[-1] - values[0]))
    shares = (1.0 - (at.unsqueeze(-2) - bins.unsqueeze(-1)).abs()).clamp(min=0.0)
    return (probs.unsqueeze(-2) * shares).sum(dim=-1)  # one kernel once it is compiled


def lower_of(log_probs: Tensor, means: Tensor) -> Tensor:
    """Return the log-probabilities of the critic with the lower mean, sample by sample (TD3, arXiv 1802.09477).

    Shapes: (2, samples, num_bins) and (2, samples).
    """
    return torch.where((means[0] <= means[1]).unsqueeze(-1), log_probs[0], log_probs[1])
