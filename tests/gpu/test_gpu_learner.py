"""PPO's Triton kernels, compiled for the GPU, in TF32 and bfloat16, against torch's autograd, Adam and formulas."""

import copy

import numpy as np
import pytest
import torch
from support.on_device import gradient_errors
from support.rollouts import record_rollout
from support.wide_ppo import MIRROR, STEPS, assert_steps_are_those_of_torch, build, choose, mirrored
from tensordict import TensorDict

from legged_torque.learning.ppo import OnDevicePPO
from legged_torque.sim.graph import CudaGraph

pytest.importorskip("triton", reason="Triton is there for Linux only")

TOLERANCES = {"TF32": 0.04, "bfloat16": 0.1}
"""Largest norm of a gradient's error, in parts of the gradient's: the gradients of samples mostly cancel.

Up to 2.2% were seen in TF32, on an H100."""


def make(device, precision="TF32", **settings):
    """An algorithm with kernels."""
    if precision == "bfloat16" and device == "cpu":
        pytest.skip("needs a GPU")
    from legged_torque.learning.ppo.triton.triton_ppo import TritonPPO

    kind = TritonPPO if device == "cpu" else OnDevicePPO.make
    alg = build(kind, device, use_mixed_precision=precision == "bfloat16", **settings)
    assert type(alg) is TritonPPO and (alg.product_dtype == torch.bfloat16) == (precision == "bfloat16")
    return alg


@pytest.mark.parametrize("precision", TOLERANCES)
def test_rollout(device, precision):
    """Values, log-probabilities, returns and advantages are those of the networks, and of GAE worked out in float64."""
    alg = make(device, multi_head=True, precision=precision)
    (_, last), rollout = record_rollout(alg), alg.storage
    close = {"rtol": 2e-2, "atol": 2e-2} if precision == "bfloat16" else {"rtol": 2e-3, "atol": 2e-3}
    with torch.no_grad():
        observations = rollout.observations.flatten(0, 1)
        torch.testing.assert_close(rollout.values.flatten(0, 1), alg.critic(observations), **close)
        alg.actor(observations, stochastic_output=True)
        means = alg.actor.output_distribution_params[0]
        torch.testing.assert_close(rollout.distribution_params[0].flatten(0, 1), means, **close)
        final = alg.critic(last).double().cpu().numpy()
    kept = {"means": rollout.distribution_params[0], "stds": rollout.distribution_params[1]}
    kept |= {name: getattr(rollout, name) for name in ("actions", "actions_log_prob", "rewards", "dones", "values")}
    of = {name: values.double().cpu().numpy() for name, values in kept.items()}
    density = -0.5 * ((of["actions"] - of["means"]) / of["stds"]) ** 2 - np.log(of["stds"] * np.sqrt(2.0 * np.pi))
    np.testing.assert_allclose(of["actions_log_prob"][..., 0], density.sum(axis=2), rtol=1e-4, atol=1e-4)
    advantage, returns, following = 0.0, [], final
    for step in reversed(range(STEPS)):
        goes_on = 1.0 - of["dones"][step]
        error = of["rewards"][step] + 0.99 * goes_on * following - of["values"][step]
        advantage = error + 0.99 * 0.95 * goes_on * advantage
        returns.insert(0, advantage + of["values"][step])
        following = of["values"][step]
    np.testing.assert_allclose(rollout.returns.cpu().numpy(), returns, **close)
    advantages = rollout.returns.double() - rollout.values.double()
    expected = ((advantages - advantages.mean()) / advantages.std()).float()
    torch.testing.assert_close(rollout.advantages, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("precision", TOLERANCES)
def test_gradients(device, precision):
    """Those of autograd, also of a policy that has moved since it acted; one that has not moved has no divergence.

    No ratio is clipped: near the limit, rounding would decide. The same test in Triton's interpreter clips them.
    """
    close = TOLERANCES[precision]
    for kind in ({}, {"multi_head": True, "symmetric": "images"}):
        alg = make(device, precision=precision, max_grad_norm=1e9, clip_param=10.0, learning_rate=1e-2, **kind)
        record_rollout(alg)
        graph = CudaGraph(alg.update_minibatch, device)
        for number in range(3):
            choose([alg], number)
            errors = gradient_errors(alg)
            assert max(errors.values()) < close, errors
            expected = alg.loss()[1].tolist()
            alg.losses.zero_()
            graph()
            np.testing.assert_allclose(alg.losses[:4].tolist(), expected, rtol=close, atol=0.1 * close)
            assert number or abs(float(alg.losses[3])) < 1e-5


def test_steps_are_those_of_torch(device):
    """Those of torch's Adam."""
    alg = make(device, max_grad_norm=0.05)
    assert_steps_are_those_of_torch(alg, CudaGraph(alg.update_minibatch, device), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("precision", TOLERANCES)
def test_equivariant_networks(device, precision):
    """After updates, mirrored observations give mirrored actions and the same values; float64 shows the weights."""
    alg = make(device, multi_head=True, symmetric="networks", precision=precision)
    before = alg.tensors()[0].clone()
    for seed in range(3):
        record_rollout(alg, seed)
        assert alg.update()["skipped_updates"] == 0.0
    assert (alg.tensors()[0] != before).float().mean() > 0.99
    actor, critic = (copy.deepcopy(model).double().cpu() for model in (alg.actor, alg.critic))
    obs = TensorDict({name: torch.randn(30, len(MIRROR[name][0])).double() for name in ("policy", "critic")}, [30])
    images = TensorDict({name: mirrored(name, values) for name, values in obs.items()}, [30])
    torch.testing.assert_close(actor(images), mirrored("actions", actor(obs)), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(critic(images), critic(obs), rtol=1e-9, atol=1e-9)


def test_a_bad_sample_changes_nothing(device):
    """Of its minibatch nothing is learned, to the bit; the next one is learned from as if it had never been."""
    spoiled, healthy = (make(device, multi_head=True, symmetric="images") for _ in range(2))
    for alg in (spoiled, healthy):
        record_rollout(alg)
    spoiled.storage.returns[0, 2] = torch.nan
    spoiled.indices.copy_(torch.arange(spoiled.batch_size))
    before = [tensor.clone() for tensor in spoiled.tensors()]
    graphs = [CudaGraph(alg.update_minibatch, device) for alg in (spoiled, healthy)]
    for count in (1.0, 2.0):  # the second step is a replay
        graphs[0]()
        assert all(map(torch.equal, spoiled.tensors(), before)) and float(spoiled.losses[-1]) == count
    for alg, graph in zip((spoiled, healthy), graphs, strict=True):
        alg.indices.copy_(torch.arange(60, 60 + alg.batch_size))
        graph()
    assert all(map(torch.equal, spoiled.tensors(), healthy.tensors()))


def test_the_same_bits_twice(device):
    """Rollouts and updates repeat to the bit, replayed or not, with the training's precision if there is a GPU."""
    states = []
    for replays in (True, True, False):
        alg = make(device, multi_head=True, symmetric="images", precision="TF32" if device == "cpu" else "bfloat16")
        alg.update_graph.enabled = replays
        record_rollout(alg)
        alg.update()
        changed = (*alg.tensors(), *alg.storage.observations.values(), alg.storage.actions, alg.losses)
        states.append([tensor.clone() for tensor in changed])
    assert all(torch.equal(first, other) for state in states for first, other in zip(states[0], state, strict=True))
