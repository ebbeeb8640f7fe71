"""FlashSAC's pieces against torch's own operations, and formulas in loops."""

import math

import numpy as np
import pytest
import torch
from support.point_masses import PointMasses
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from legged_torque.learning.flashsac.exploration import RepeatedNoise
from legged_torque.learning.flashsac.networks import Trunk, UnitBatchNorm, UnitLinear, bound_weights, squashed
from legged_torque.learning.flashsac.replay import Replay
from legged_torque.learning.flashsac.returns import RewardScale, projected
from legged_torque.learning.protocols import Transition


@pytest.mark.parametrize("copies", [(), (2,)])
def test_batch_normalization(copies):
    """Outputs, gradients and running statistics are torch's, of each copy alone, in learning and in use."""
    torch.manual_seed(0)
    ours, inputs = UnitBatchNorm(5, copies), (3.0 * torch.randn(*copies, 40, 5) + 1.0).requires_grad_()
    index, theirs = (1,) * len(copies), torch.nn.BatchNorm1d(5, momentum=0.01)
    theirs.load_state_dict({"weight": ours.scale[index], "bias": ours.shift[index]}, strict=False)
    twin = inputs[index].detach().requires_grad_()
    for learning in (True, False):
        outputs, expected = ours(inputs, learning), theirs.train(learning)(twin)
        grads = [torch.autograd.grad(y.pow(3).sum(), x)[0] for y, x in ((outputs, inputs), (expected, twin))]
        torch.testing.assert_close(outputs[index], expected)
        torch.testing.assert_close(grads[0][index], grads[1], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(ours.mean[index], theirs.running_mean)
    torch.testing.assert_close(ours.var[index], theirs.running_var)


def test_norms_are_bounded():
    """Rows of weights have the norm 1, normalizations sqrt(size), and so have features of any input."""
    torch.manual_seed(0)
    trunk = Trunk(7, 16, 2, (2,))
    with torch.no_grad():
        for parameter in trunk.parameters():
            parameter.add_(3.0 * torch.randn_like(parameter))
    bound_weights(trunk)
    for module in (module for module in trunk.modules() if hasattr(module, "bound")):
        if isinstance(module, UnitLinear):
            torch.testing.assert_close(module.weight.norm(dim=-1), torch.ones(module.weight.shape[:-1]))
        else:
            norms = torch.cat(list(module.parameters()), dim=-1).norm(dim=-1)
            torch.testing.assert_close(norms, torch.full((2,), math.sqrt(module.scale.shape[-1])))
    features = trunk((1e3 * torch.randn(30, 7)).expand(2, 30, 7), True) / trunk.norm.scale.unsqueeze(1)
    torch.testing.assert_close(features.norm(dim=-1), torch.full((2, 30), 4.0), atol=1e-3, rtol=1e-3)


def test_log_density_of_squashed_actions():
    """It and its gradients are those of torch's transformed distribution; it is finite where tanh has saturated."""
    torch.manual_seed(0)
    mean, std, draw = torch.randn(3, 6, 2, dtype=torch.float64).unbind()
    parameters = mean.requires_grad_(), (std.abs() + 0.1).detach().requires_grad_()
    actions, ours = squashed(*parameters, draw)
    theirs = TransformedDistribution(Normal(*parameters), TanhTransform(cache_size=1)).log_prob(actions).sum(dim=1)
    torch.testing.assert_close(ours, theirs)
    grads = [torch.autograd.grad(part.sum(), parameters, retain_graph=True) for part in (ours, theirs)]
    torch.testing.assert_close(grads[0], grads[1])
    assert torch.isfinite(squashed(torch.full((1, 1), 60.0), torch.ones(1, 1), torch.zeros(1, 1))[1])


def test_projection():
    """It is C51's, in loops; the mean stays where no place is outside of the values."""
    rng, values = np.random.default_rng(0), np.linspace(-2.0, 2.0, 9)
    probs, places = rng.dirichlet(np.ones(9), size=20), rng.normal(0.0, 2.0, (20, 9))
    places[0], places[1], places[2:10] = values, 0.3, np.clip(places[2:10], -2.0, 2.0)
    expected = np.zeros((20, 9))
    for row, prob, place in zip(expected, probs, places, strict=True):
        for share, at in zip(prob, (np.clip(place, -2.0, 2.0) + 2.0) / 0.5, strict=True):
            low = min(int(at), 7)
            row[low] += share * (low + 1 - at)
            row[low + 1] += share * (at - low)
    ours = projected(*(torch.as_tensor(part, dtype=torch.float32) for part in (probs, places, values))).numpy()
    np.testing.assert_allclose(ours, expected, atol=1e-6)
    np.testing.assert_allclose(ours[:10] @ values, (probs * places).sum(axis=1)[:10], atol=1e-5)


def test_reward_scale():
    """It is the larger of the deviation of all returns and the largest one over the bound, of each episode alone."""
    rng = np.random.default_rng(0)
    rewards, dones = rng.normal(0.5, 1.0, (50, 4)), rng.random((50, 4)) < 0.1
    for bound in (1.0, 100.0):
        ours, running, now, returns = RewardScale(0.9, bound), torch.zeros(4), np.zeros(4), []
        for reward, done in zip(rewards, dones, strict=True):
            ours.follow(running, torch.tensor(reward, dtype=torch.float32), torch.tensor(done))
            now = 0.9 * now + reward
            returns.append(now)
            now = np.where(done, 0.0, now)
        assert float(ours.scale()) == pytest.approx(max(np.std(returns), np.abs(returns).max() / bound), rel=1e-5)


def test_noise_is_repeated():
    """Runs of equal noise have lengths with probabilities in proportion to n^-2; its numbers are standard normal."""
    torch.manual_seed(0)
    noise = RepeatedNoise(3, 2, 2.0, 4, "cpu")
    rows = torch.stack([noise.next().clone() for _ in range(6000)])
    ends = np.flatnonzero((rows[1:] != rows[:-1]).any(dim=(1, 2)).numpy()) + 1
    shares, weights = np.bincount(np.diff(ends), minlength=5)[1:] / (len(ends) - 1), 1.0 / np.arange(1, 5) ** 2
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=0.03)
    drawn = rows[ends]
    assert abs(float(drawn.mean())) < 0.03 and abs(float(drawn.std()) - 1.0) < 0.03


@pytest.mark.parametrize(("steps", "num_steps"), [(30, 1), (90, 3)])
def test_replay(steps, num_steps):
    """Samples are what has happened, also across ends of episodes and after the ring has been filled."""
    torch.manual_seed(0)
    task, happened, left_out = PointMasses(num_envs=4), {}, set()
    task.keep_final_observations, task.max_episode_length, obs = True, 7, task.get_observations()
    replay = Replay(obs, ["policy"], 1, 4 * 40, torch.float32, "cpu")
    replay.allocate()
    for number in range(steps):  # kept by the observation before a step, which no other step has
        actions = 2.0 * torch.rand(4, 1)
        after, rewards, dones, extras = task.step(actions)
        final, time_outs = extras["final_observations"], extras["time_outs"]
        replay.add(Transition(obs, actions, rewards, dones, time_outs, after, final, extras), actions)
        parts = (obs["policy"], actions, rewards, final["policy"], after["policy"], dones, time_outs)
        for key, *row in zip(*(part.flatten().tolist() for part in parts), strict=True):
            happened[key] = (number, *row)
        left_out |= set(after["policy"].flatten()[time_outs].tolist())
        obs = after
    batch, seen, ends = replay.sample(3000, num_steps, 0.9), set(), set()
    parts = (batch.obs["policy"], batch.actions, batch.rewards, batch.discounts, batch.next_obs["policy"])
    kept = batch.weights.bool()
    for key, action, reward, discount, next_obs in zip(*(part.flatten()[kept].tolist() for part in parts), strict=True):
        number, own_action, total, final, after, done, timed_out = happened[key]
        factor = 0.9
        while not done and factor > 1.01 * 0.9**num_steps:
            _, _, more, final, after, done, timed_out = happened[after]
            total, factor = total + factor * more, 0.9 * factor
        seen.add(key)
        ends.add((done, timed_out))
        wanted = (own_action, total, 0.0 if done and not timed_out else factor)
        assert (action, reward, discount) == pytest.approx(wanted, rel=1e-5)
        assert next_obs == final or (done and not timed_out)
    young = {key for key, (number, *_) in happened.items() if steps - 40 <= number < steps - num_steps}
    assert seen == young - left_out and ends == {(False, False), (True, False), (True, True)}
