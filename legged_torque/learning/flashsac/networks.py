"""FlashSAC's networks: residual blocks whose weights and features have bounded norms (arXiv 2604.04539).

Weights that act on one feature have the norm 1 after each gradient step, scales and shifts of a normalization together
the root of their number. Features pass a batch normalization, whose running means also normalize observations, and an
RMS normalization before the last layer. Gradients are bounded by these and by the critic's cross-entropy.

``copies`` are leading dimensions of all weights: () for a single network, (2,) for two critics in one. Inside, samples
are columns: batch normalizations then run along memory, and gradients of weights have the layout of the weights.
"""

import copy
import math

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from legged_torque.utils.errors import UserError

LOG_STD = (-10.0, 2.0)
"""Bounds of the logarithm of the standard deviation of actions, before tanh."""
EXPANSION = 4  # size of a block's inner layer, in those of its outer one


class UnitLinear(nn.Module):
    """A linear layer without shift whose rows have the norm 1."""

    def __init__(self, num_inputs: int, num_outputs: int, copies: tuple[int, ...] = ()) -> None:
        """Start from orthogonal weights."""
        super().__init__()
        self.weight = nn.Parameter(torch.empty(*copies, num_outputs, num_inputs))
        for weight in self.weight.detach().view(-1, num_outputs, num_inputs):
            nn.init.orthogonal_(weight)

    def forward(self, x: Tensor) -> Tensor:
        """Return float32 outputs, whatever autocast multiplies. Shape: (..., num_outputs, samples)."""
        product = self.aligned_product(x) if x.is_cuda else self.weight @ x
        return product.float()

    def aligned_product(self, x: Tensor) -> Tensor:
        """Return the outputs by a product with multiples of 8 inputs and outputs, far faster on a GPU."""
        num_outputs, num_inputs = self.weight.shape[-2], self.weight.shape[-1]
        behind, below = -num_inputs % 8, -num_outputs % 8
        weight = nn.functional.pad(self.weight, [0, behind, 0, below])
        return (weight @ nn.functional.pad(x, [0, 0, 0, behind]))[..., :num_outputs, :]

    @torch.jit.unused
    def bound(self) -> None:
        """Scale the rows to the norm 1."""
        self.weight.div_(self.weight.norm(dim=-1, keepdim=True).clamp(min=1e-8))


class UnitBatchNorm(nn.Module):
    """Batch normalization whose scales and shifts together have the norm sqrt(size)."""

    mean: Tensor
    var: Tensor

    def __init__(self, size: int, copies: tuple[int, ...] = ()) -> None:
        """Start with scales 1, shifts 0, running means 0 and variances 1."""
        super().__init__()
        self.scale, self.shift = nn.Parameter(torch.ones(*copies, size)), nn.Parameter(torch.zeros(*copies, size))
        self.register_buffer("mean", torch.zeros(*copies, size))
        self.register_buffer("var", torch.ones(*copies, size))

    def forward(self, x: Tensor, learning: bool) -> Tensor:
        """Normalize by the running statistics, or if it is ``learning`` by those of the batch, which they follow.

        Shapes: (..., size, samples).
        """
        mean, var, scale, shift = self.mean.flatten(), self.var.flatten(), self.scale.flatten(), self.shift.flatten()
        rows = x.flatten(0, -2).unsqueeze(0)  # features of all copies behind each other
        return nn.functional.batch_norm(rows, mean, var, scale, shift, learning, momentum=0.01).view(x.shape)

    @torch.jit.unused
    def bound(self) -> None:
        """Scale both to their norm."""
        squares = (self.scale.square() + self.shift.square()).sum(dim=-1, keepdim=True)
        factor = torch.rsqrt(squares / self.scale.shape[-1] + 1e-8)
        self.scale.mul_(factor)
        self.shift.mul_(factor)


class UnitRMSNorm(nn.Module):
    """Normalization of each sample by the root of its mean square, with scales of the norm sqrt(size)."""

    def __init__(self, size: int, copies: tuple[int, ...] = ()) -> None:
        """Start with scales 1."""
        super().__init__()
        self.scale = nn.Parameter(torch.ones(*copies, size))

    def forward(self, x: Tensor) -> Tensor:
        """Return the normalized samples. Shape: (..., size, samples)."""
        return x * torch.rsqrt(x.square().mean(dim=-2, keepdim=True) + 1e-6) * self.scale.unsqueeze(-1)

    @torch.jit.unused
    def bound(self) -> None:
        """Scale the scales to their norm."""
        self.scale.mul_(torch.rsqrt(self.scale.square().mean(dim=-1, keepdim=True) + 1e-8))


class Block(nn.Module):
    """Two layers, each with batch normalization and ReLU, around which their input passes."""

    def __init__(self, size: int, copies: tuple[int, ...] = ()) -> None:
        """Create the layers, of which the first is :data:`EXPANSION` times as wide."""
        super().__init__()
        inner = EXPANSION * size
        self.first, self.first_norm = UnitLinear(size, inner, copies), UnitBatchNorm(inner, copies)
        self.second, self.second_norm = UnitLinear(inner, size, copies), UnitBatchNorm(size, copies)

    def forward(self, x: Tensor, learning: bool) -> Tensor:
        """Return features of the same shape; ``learning`` as of :class:`UnitBatchNorm`."""
        inner = torch.relu(self.first_norm(self.first(x), learning))
        return x + torch.relu(self.second_norm(self.second(inner), learning))


class Trunk(nn.Module):
    """From inputs to features of bounded norm."""

    def __init__(self, num_inputs: int, hidden_dim: int, num_blocks: int, copies: tuple[int, ...] = ()) -> None:
        """Create the layers."""
        super().__init__()
        self.input_norm = UnitBatchNorm(num_inputs, copies)
        self.input_layer = UnitLinear(num_inputs, hidden_dim, copies)
        self.blocks = nn.ModuleList([Block(hidden_dim, copies) for _ in range(num_blocks)])
        self.norm = UnitRMSNorm(hidden_dim, copies)

    def forward(self, x: Tensor, learning: bool) -> Tensor:
        """Return features of inputs, ``learning`` as of :class:`UnitBatchNorm`.

        Shapes: (*copies, samples, num_inputs) to (*copies, hidden_dim, samples).
        """
        x = self.input_layer(self.input_norm(x.transpose(-1, -2), learning))
        for block in self.blocks:
            x = block(x, learning)
        return self.norm(x)


class FlashSACActor(nn.Module):
    """The policy: from observations to the mean and standard deviation of actions, which a tanh bounds.

    Its methods for export are those of rsl_rl's models.

    Attributes:
        obs_groups: Groups of observations that it reads.
        obs_dim: Their size together.
        action_bound: Largest action, either way, in the task's units.
    """

    is_recurrent = False

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        action_bound: float,
        hidden_dim: int = 128,
        num_blocks: int = 2,
    ) -> None:
        """Create the network; arguments are those of rsl_rl's models, and sizes."""
        super().__init__()
        self.obs_groups, self.action_bound = obs_groups[obs_set], action_bound
        self.obs_dim = observation_size(obs, self.obs_groups)
        self.trunk = Trunk(self.obs_dim, hidden_dim, num_blocks)
        self.head, self.head_shift = UnitLinear(hidden_dim, 2 * output_dim), nn.Parameter(torch.zeros(2 * output_dim))
        bound_weights(self)

    def forward(self, obs: TensorDict) -> Tensor:
        """Return mean actions in the task's units. Shape: (samples, num_actions)."""
        return self.action_bound * torch.tanh(self.distribution(obs, False)[0])

    def distribution(self, obs: TensorDict, learning: bool) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation before tanh. Shapes: (samples, num_actions)."""
        inputs = torch.cat([obs[group] for group in self.obs_groups], dim=-1)
        mean, raw = (self.head(self.trunk(inputs, learning)).transpose(-1, -2) + self.head_shift).chunk(2, dim=-1)
        low, high = LOG_STD
        return mean, torch.exp(low + (high - low) * 0.5 * (1.0 + torch.tanh(raw)))

    def sample(self, obs: TensorDict, learning: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Return random actions in [-1, 1], their log-densities, shape (samples,), and the standard deviations."""
        mean, std = self.distribution(obs, learning)
        return *squashed(mean, std, torch.randn_like(mean)), std

    def as_jit(self) -> nn.Module:
        """Return mean actions as a module of concatenated observations, for TorchScript."""
        return MeanActions(self)

    def as_onnx(self, verbose: bool) -> nn.Module:
        """Return the same for ONNX."""
        return MeanActions(self)


class MeanActions(nn.Module):
    """Mean actions of an actor, from observations in one tensor."""

    def __init__(self, actor: FlashSACActor) -> None:
        """Copy the actor's network."""
        super().__init__()
        num_actions = len(actor.head_shift) // 2
        self.trunk, self.action_bound = copy.deepcopy(actor.trunk), actor.action_bound
        self.weight = nn.Parameter(actor.head.weight.detach()[:num_actions].clone())
        self.shift = nn.Parameter(actor.head_shift.detach()[:num_actions].clone())

    def forward(self, x: Tensor) -> Tensor:
        """Return mean actions in the task's units. Shape: (samples, num_actions)."""
        mean = nn.functional.linear(self.trunk(x, False).transpose(-1, -2), self.weight, self.shift)
        return self.action_bound * torch.tanh(mean)

    @torch.jit.export
    def reset(self) -> None:
        """Forget nothing: the policy has no memory."""


class FlashSACCritic(nn.Module):
    """Two critics in one, each with a distribution over fixed values of what an action will earn.

    Attributes:
        values: The values. Shape: (num_bins,).
    """

    values: Tensor

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        num_actions: int,
        largest: float,
        hidden_dim: int = 256,
        num_blocks: int = 2,
        num_bins: int = 101,
    ) -> None:
        """Create the networks, for ``num_bins`` values from -``largest`` to ``largest``."""
        super().__init__()
        self.obs_groups, copies = obs_groups[obs_set], (2,)
        self.trunk = Trunk(observation_size(obs, self.obs_groups) + num_actions, hidden_dim, num_blocks, copies)
        self.head, self.head_shift = UnitLinear(hidden_dim, num_bins, copies), nn.Parameter(torch.zeros(2, num_bins))
        self.register_buffer("values", torch.linspace(-largest, largest, num_bins))
        bound_weights(self)

    def forward(self, obs: TensorDict, actions: Tensor, learning: bool) -> tuple[Tensor, Tensor]:
        """Return log-probabilities of the values, shape (2, samples, num_bins), and means, shape (2, samples).

        Actions are in [-1, 1]. Shape: (samples, num_actions).
        """
        inputs = torch.cat([*(obs[group] for group in self.obs_groups), actions], dim=-1)
        features = self.trunk(inputs.expand(2, *inputs.shape), learning)
        logits = self.head(features).transpose(-1, -2) + self.head_shift.unsqueeze(-2)
        log_probs = torch.log_softmax(logits, dim=-1)
        return log_probs, (log_probs.exp() * self.values).sum(dim=-1)


def squashed(mean: Tensor, std: Tensor, draw: Tensor) -> tuple[Tensor, Tensor]:
    """Return actions tanh(mean + std draw) of a standard normal ``draw``, and their log-densities.

    A change of variables: the log-density of the normal distribution minus log(1 - tanh(u)^2), in a form that stays
    finite (SAC, arXiv 1812.05905, appendix C). Shapes: (samples, num_actions) and (samples,).
    """
    inner = mean + std * draw
    normal = -0.5 * draw.square() - std.log() - 0.5 * math.log(2.0 * math.pi)
    stretch = 2.0 * (math.log(2.0) - inner - nn.functional.softplus(-2.0 * inner))
    return torch.tanh(inner), (normal - stretch).sum(dim=-1)


@torch.no_grad()
def bound_weights(network: nn.Module) -> None:
    """Scale all weights of a network to their norms."""
    for module in network.modules():
        if isinstance(module, (UnitLinear, UnitBatchNorm, UnitRMSNorm)):
            module.bound()


def observation_size(obs: TensorDict, groups: list[str]) -> int:
    """Return the size of groups of observations together; a UserError if one is not of vectors."""
    for group in groups:
        if obs[group].dim() != 2:
            raise UserError(f"FlashSAC reads vectors, and '{group}' has the shape {tuple(obs[group].shape[1:])}")
    return sum(obs[group].shape[1] for group in groups)
