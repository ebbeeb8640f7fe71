"""Compares training with CUDA graphs to training without."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from legged_torque.learning.runner import OnPolicyRunner
from legged_torque.utils.task_registry import set_seed

WARM_UP_ITERATIONS = 2  # iterations before everything is replayed: the first runs as it is, the second captures
KERNEL_TOLERANCE = 0.1
"""Accepted relative error of gradients by the update's kernels. Products of bfloat16 numbers are right to 0.4%, but the
gradients of samples mostly cancel: 3% for an actor that has just begun to learn."""
NOISE_FACTOR = 3.0
"""Accepted difference, in differences of two runs without graphs, where only the order of additions differs."""
_LEARNED_FROM = ("observations", "actions", "values", "actions_log_prob", "returns", "advantages")


@dataclass
class Difference:
    """The difference of a quantity with and without graphs.

    On a GPU threads add in any order, and rounding errors grow where feet touch the ground: errors of 1e-7 per step
    make rewards differ by 2% (rms) over 24 steps.
    """

    largest: float  # largest absolute difference
    relative: float  # the same, relative to the largest absolute value
    rms: float  # of the differences, relative to that of the values; NaN if any of them is not finite
    repeated: float  # rms of two runs without graphs

    def within(self, tolerance: float) -> bool:
        """Return whether ``rms`` is within the tolerance or close to ``repeated``. NaN is not."""
        return self.rms <= max(tolerance, NOISE_FACTOR * self.repeated)


def compare_capture(plain: OnPolicyRunner, captured: OnPolicyRunner, seed: int) -> dict[str, Difference]:
    """Run the same iteration with both runners, and with ``plain`` twice.

    All three start from the networks, counters and worlds of ``plain``, with new episodes and the same random numbers.
    They learn from the rollout of ``plain``, so that differences between rollouts do not hide those of the update. The
    runners, with ``runner.capture`` off and on, come from :func:`warm_up`.

    Returns:
        By quantity: observations by group, actions, rewards, returns, the changes of actor and critic, and all losses.
    """
    start = [tensor.clone() for tensor in _state(plain)], copy.deepcopy(plain.env.world_state_dict())
    expected, rollout = _iterate(plain, start, seed)
    repeated, _ = _iterate(plain, start, seed, rollout)
    actual, _ = _iterate(captured, start, seed, rollout)
    return {name: _compare(actual[name], value, repeated[name]) for name, value in expected.items()}


@torch.no_grad()
def compare_kernels(runner: OnPolicyRunner) -> dict[str, float]:
    """Compare the gradients of the update's kernels with autograd's, for the first samples of the last rollout.

    Returns:
        By network: the norm of the difference, relative to that of autograd's gradient; nothing without kernels.
    """
    alg = runner.alg
    if not hasattr(alg, "gradients"):
        return {}
    alg.indices.copy_(torch.arange(alg.batch_size))
    before, rate = [tensor.clone() for tensor in alg.tensors()], alg.learning_rate.clone()
    alg.update_minibatch()
    fused = [gradient.clone() for gradient in alg.gradients()]
    for tensor, value in zip([*alg.tensors(), alg.learning_rate], [*before, rate], strict=True):
        tensor.copy_(value)
    alg.round_weights()
    alg.optimizer.zero_grad()
    with torch.enable_grad():
        alg.loss()[0].backward()
    result, start = {}, 0
    for name, network in {"actor": alg.actor, "critic": alg.critic}.items():
        exact = torch.cat([parameter.grad.flatten() for parameter in network.parameters()])
        parts = fused[start : start + len(list(network.parameters()))]
        start += len(parts)
        found = torch.cat([gradient.flatten() for gradient in parts])
        result[name] = float((found - exact).norm() / exact.norm())
    return result


def warm_up(runner: OnPolicyRunner) -> None:
    """Run the iterations after which everything that can be captured is replayed."""
    runner.alg.train_mode()
    if runner.is_distributed:
        runner.alg.broadcast_parameters()
    for _ in range(WARM_UP_ITERATIONS):
        runner.collect_rollout()
        runner.alg.update()


def _state(runner: OnPolicyRunner) -> list[Tensor]:
    """Return the tensors that training carries between iterations besides the worlds: networks, optimizer, counters."""
    alg = runner.alg
    networks = [*alg.actor.state_dict().values(), *alg.critic.state_dict().values()]
    moments = [tensor for entry in alg.optimizer.state.values() for tensor in entry.values()]
    return [*networks, *moments, alg.learning_rate, runner.env.total_steps]


def _iterate(
    runner: OnPolicyRunner, start: tuple[list[Tensor], dict], seed: int, rollout: list[Tensor] | None = None
) -> tuple[dict[str, Tensor], list[Tensor]]:
    """Run one iteration from a :func:`_state` and worlds; return all quantities, and the rollout learned from."""
    env, storage = runner.env, runner.alg.storage
    state, worlds = start
    for tensor, value in zip(_state(runner), state, strict=True):
        tensor.copy_(value)
    env.load_world_state_dict(worlds)
    set_seed(seed)
    env.reset()
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=int(env.max_episode_length))
    runner.collect_rollout()
    result = {f"observations {group}": value.clone() for group, value in storage.observations.items()}
    result |= {name: getattr(storage, name).clone() for name in ("actions", "rewards", "returns")}
    mean, _ = storage.distribution_params  # the deviations are those of the same networks
    learned_from = [*(getattr(storage, name) for name in _LEARNED_FROM), mean]
    rollout = rollout or [tensor.clone() for tensor in learned_from]
    for tensor, value in zip(learned_from, rollout, strict=True):
        tensor.copy_(value)
    networks = {"actor": runner.alg.actor, "critic": runner.alg.critic}
    before = {name: parameters_to_vector(network.parameters()).detach() for name, network in networks.items()}
    set_seed(seed)
    losses = runner.alg.update()
    for name, network in networks.items():
        result[f"change of {name}"] = parameters_to_vector(network.parameters()).detach() - before[name]
    result |= {f"loss {name}": torch.tensor([float(value)]) for name, value in losses.items()}
    return result, rollout


def _compare(actual: Tensor, expected: Tensor, repeated: Tensor) -> Difference:
    """Return the differences of ``actual`` and ``repeated`` from ``expected``."""

    def ratio(error: Tensor, size: Tensor) -> float:
        return float(error / size) if error != 0.0 else 0.0

    def rms(tensor: Tensor) -> Tensor:
        return tensor.double().square().mean().sqrt()

    largest, size = (actual - expected).abs().max(), rms(expected)
    relative, repeated_rms = ratio(largest, expected.abs().max()), ratio(rms(repeated - expected), size)
    return Difference(float(largest), relative, ratio(rms(actual - expected), size), repeated_rms)
