"""PPO that learns on a CPU with fewer passes over memory."""

import math
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.distributions import Normal

from legged_torque.envs.base.symmetry import with_mirror_images
from legged_torque.learning.multi_head import MultiHeadMLP
from legged_torque.learning.ppo.torch_ppo import TorchPPO

_CPU_INFO = Path("/proc/cpuinfo")  # of Linux
_IS_INTEL = _CPU_INFO.exists() and "GenuineIntel" in _CPU_INFO.read_text(encoding="utf-8")
_HAS_AVX512 = torch.backends.cpu.get_cpu_capability().startswith("AVX512")
USE_ONEDNN = torch.backends.mkldnn.is_available() and _HAS_AVX512 and not _IS_INTEL  # mkldnn is its old name
"""Whether oneDNN multiplies matrices, not MKL.

On one AMD EPYC it took half the time of MKL; on one without AVX-512 and on a Xeon, it takes 1.1 to 1.5 times as much.
That AVX-512 makes the difference between AMD's CPUs is a guess: the first one is not known any more.
"""


class CpuPPO(TorchPPO):
    """Does what :class:`TorchPPO` does, for networks with ELUs.

    Mirror images are made once per rollout, no actions are sampled to learn, and ELUs and, on some CPUs, products are
    faster.
    """

    _samples: tuple[Tensor, ...]  # of a rollout and its mirror images: what actor and critic see, and actions

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and advantages, and the mirror images of the rollout."""
        super().compute_returns(obs)
        seen, actions = self.storage.observations.flatten(0, 1), self.storage.actions.flatten(0, 1)
        if self.symmetry:
            seen, actions = with_mirror_images(self.symmetry.env, seen, actions)
        self._samples = self.actor.get_latent(seen), self.critic.get_latent(seen), actions

    def loss(self) -> tuple[Tensor, Tensor]:
        """Return what :meth:`TorchPPO.loss` does, up to rounding."""
        originals = self.storage.actions[..., 0].numel()
        images = len(self._samples[-1]) // originals
        places = torch.cat([self.indices + image * originals for image in range(images)])
        seen, critic_seen, actions = (values.index_select(0, places) for values in self._samples)
        means, distribution = run_network(self.actor.mlp, seen), self.actor.distribution
        distribution.update(means[:1])
        distribution._distribution = _SharedDeviation(means, distribution.std[0])
        return self._losses(self._gather_results(actions, images), run_network(self.critic.mlp, critic_seen))


class _SharedDeviation(Normal):
    """A normal distribution that computes what depends on the deviation alone once, not per sample."""

    def __init__(self, means: Tensor, deviation: Tensor) -> None:
        """Keep means and deviations. Shapes: (samples, size) and (size,)."""
        self.loc, self.scale = means, deviation

    @property
    def stddev(self) -> Tensor:
        """Return the deviations of all samples. Shape: (samples, size)."""
        return self.scale.expand_as(self.loc)


def run_network(network: nn.Module, inputs: Tensor) -> Tensor:
    """Return the outputs of an rsl_rl ``MLP`` or of our ``MultiHeadMLP`` with ELUs. Shape: (samples, outputs)."""
    if isinstance(network, MultiHeadMLP):
        features = run_network(network.trunk, inputs)
        positions = run_network(network.position_head, features)
        torques = run_network(network.torque_head, torch.cat([features, positions], dim=-1))
        return torch.cat([positions, torques], dim=-1)
    for layer in network:  # type: ignore[attr-defined]
        if isinstance(layer, nn.Linear) and USE_ONEDNN:
            inputs = _Linear.apply(inputs, layer.weight, layer.bias)
        else:
            inputs = _Elu.apply(inputs) if isinstance(layer, nn.ELU) else layer(inputs)
    return inputs


class _Linear(torch.autograd.Function):
    """A linear layer by oneDNN."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Return the outputs. Shapes: (samples, inputs), (outputs, inputs) and (outputs,)."""
        ctx.save_for_backward(inputs, weight)
        return _product(inputs, weight, bias)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        """Return the gradients of inputs, weight and bias."""
        inputs, weight = ctx.saved_tensors
        of_inputs = _product(gradient, weight.T) if ctx.needs_input_grad[0] else None
        return of_inputs, _product(gradient.T, inputs.T), gradient.sum(0)


def _product(left: Tensor, right: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return the product of a matrix and the transpose of another one, plus a bias, all float32."""
    return torch.ops.mkldnn._linear_pointwise(left, right, bias, "none", [], "")


class _Elu(torch.autograd.Function):
    """An ELU in place of its inputs by exp2, which takes less time than the expm1 of torch."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        """Overwrite values with their ELU."""
        powers = (values * math.log2(math.e)).clamp_(max=0.0).exp2_().sub_(1.0)
        ctx.mark_dirty(torch.maximum(values, powers, out=values))
        ctx.save_for_backward(values)
        return values

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Return the gradient of what was overwritten."""
        return torch.ops.aten.elu_backward(gradient, 1.0, 1.0, 1.0, True, ctx.saved_tensors[0])
