"""FlashSAC's pieces against torch's own operations, and formulas in loops."""

import math

import numpy as np
import pytest
import torch
from support.point_masses import PointMasses
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from legged_torque.learning.flashsac.exploration import RepeatedNoise
from legged_torque.learning.flashsac.networks import (
    Trunk,
    UnitBatchNorm,
    UnitLinear,
    UnitRMSNorm,
    bound_weights,
    squashed,
)
from legged_torque.learning.flashsac.replay import Replay
from legged_torque.learning.flashsac.returns import RewardScale, projected
from legged_torque.learning.protocols import Transition


@pytest.mark.parametrize("copies", [(), (2,)])
def test_batch_normalization(copies):
    """Outputs, gradients and running statistics are torch's, of each copy alone, in learning and in use."""
    torch.manual_seed(0)
    ours, inputs = UnitBatchNorm(5, copies), (3.0 * torch.randn(*copies, 40, 5) + 1.0).requires_grad_()
    with torch.no_grad():
        ours.scale.normal_()
        ours.shift.normal_()
    index = (1,) * len(copies)
    theirs = torch.nn.BatchNorm1d(5, momentum=0.01)
    theirs.load_state_dict({"weight": ours.scale[index], "bias": ours.shift[index]}, strict=False)
    twin = inputs[index].detach().requires_grad_()
    for learning in (True, False):
        outputs, expected = ours(inputs, learning), theirs.train(learning)(twin)
        torch.testing.assert_close(outputs[index], expected)
        (grad,) = torch.autograd.grad(outputs[index].square().sum(), inputs)
        (twin_grad,) = torch.autograd.grad(expected.square().sum(), twin)
        torch.testing.assert_close(grad[index], twin_grad, atol=1e-4, rtol=1e-4)
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
    for module in trunk.modules():
        if isinstance(module, UnitLinear):
            torch.testing.assert_close(module.weight.norm(dim=-1), torch.ones(module.weight.shape[:-1]))
        elif isinstance(module, (UnitBatchNorm, UnitRMSNorm)):
            together = torch.cat([parameter for parameter in module.parameters()], dim=-1).square().sum(dim=-1)
            torch.testing.assert_close(together, torch.full((2,), float(module.scale.shape[-1])))
    features = trunk((1e3 * torch.randn(30, 7)).expand(2, 30, 7), True) / trunk.norm.scale.unsqueeze(1)
    torch.testing.assert_close(features.square().mean(dim=-1), torch.ones(2, 30), atol=1e-4, rtol=1e-4)


def test_log_density_of_squashed_actions():
    """It and its gradients are those of torch's transformed distribution; it is finite where tanh has saturated."""
    torch.manual_seed(0)
    mean, std = torch.randn(6, 3, dtype=torch.float64), torch.rand(6, 3, dtype=torch.float64) + 0.1
    draw = torch.randn_like(mean)
    results = []
    for own in (True, False):
        parameters = mean.clone().requires_grad_(), std.clone().requires_grad_()
        if own:
            actions, log_density = squashed(*parameters, draw)
        else:
            distribution = TransformedDistribution(Normal(*parameters), TanhTransform(cache_size=1))
            actions = torch.tanh(parameters[0] + parameters[1] * draw)
            log_density = distribution.log_prob(actions).sum(dim=1)
        grads = torch.autograd.grad(log_density.sum() + actions.sum(), parameters)
        results.append((actions, log_density, *grads))
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs)
    far = torch.full((1, 1), 60.0)
    assert math.isfinite(float(squashed(far, torch.ones(1, 1), torch.zeros(1, 1))[1]))


def test_projection():
    """It is C51's, in loops; the mean stays where no place is outside of the values."""
    rng = np.random.default_rng(0)
    values = np.linspace(-2.0, 2.0, 9)
    probs = rng.dirichlet(np.ones(9), size=20)
    places = np.clip(rng.normal(0.0, 2.0, (20, 9)), -9.0, 9.0)
    places[0], places[1] = values, 0.3  # on the values, and all at one place
    places[2:10] = np.clip(places[2:10], -2.0, 2.0)
    expected = np.zeros((20, 9))
    for i in range(20):
        for prob, place in zip(probs[i], places[i], strict=True):
            at = (min(max(place, -2.0), 2.0) + 2.0) / 0.5
            low = min(int(at), 7)
            expected[i, low] += prob * (low + 1 - at)
            expected[i, low + 1] += prob * (at - low)
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
            returns.append(now.copy())
            now[done] = 0.0
        expected = max(np.std(returns), np.abs(returns).max() / bound)
        assert float(ours.scale()) == pytest.approx(expected, rel=1e-5)


def test_noise_is_repeated():
    """Runs of equal noise have lengths with probabilities in proportion to n^-2, and its numbers are standard normal."""
    torch.manual_seed(0)
    noise, rows = RepeatedNoise(3, 2, 2.0, 4, "cpu"), []
    for _ in range(6000):
        rows.append(noise.next().clone())
    ends = [i for i in range(1, len(rows)) if not torch.equal(rows[i], rows[i - 1])]
    lengths = np.diff([0, *ends])
    shares = np.array([(lengths == n).mean() for n in (1, 2, 3, 4)])
    weights = 1.0 / np.arange(1, 5) ** 2
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=0.03)
    drawn = torch.stack([rows[end] for end in ends])
    assert abs(float(drawn.mean())) < 0.03 and abs(float(drawn.std()) - 1.0) < 0.03


@pytest.mark.parametrize(("steps", "num_steps"), [(20, 1), (20, 3), (90, 3)])
def test_replay(steps, num_steps):
    """Samples are what has happened, also across ends of episodes and after the ring has been filled."""
    torch.manual_seed(0)
    task = PointMasses(num_envs=4)
    task.keep_final_observations, task.max_episode_length = True, 7
    obs = task.get_observations()
    replay = Replay(obs, ["policy"], 1, 4 * 40, torch.float32, "cpu")
    happened, began_late = {}, set()  # by the observation before a step, which no other step has
    for number in range(steps):
        actions = 2.0 * torch.rand(4, 1)
        after, rewards, dones, extras = task.step(actions)
        final = extras["final_observations"]
        replay.add(Transition(obs, actions, rewards, dones, extras["time_outs"], after, final, extras), actions)
        for world in range(4):
            key = float(obs["policy"][world])
            end = bool(dones[world]), bool(extras["time_outs"][world])
            numbers = (float(part[world]) for part in (actions, rewards, final["policy"], after["policy"]))
            happened[key] = (number, *numbers, *end)
            if end[1]:
                began_late.add(float(after["policy"][world]))
        obs = after
    batch = replay.sample(3000, num_steps, 0.9)
    seen, kinds = set(), set()
    columns = (batch.obs["policy"], batch.actions, batch.rewards, batch.discounts, batch.next_obs["policy"])
    for key, action, reward, discount, next_obs, weight in zip(*(c.flatten().tolist() for c in columns), batch.weights):
        if not weight:
            continue
        seen.add(key)
        number, expected_action, total, final, after, done, timed_out = happened[key]
        factor = 0.9
        assert number >= steps - 40 and action == expected_action
        while not done and round(math.log(factor, 0.9)) < num_steps:
            _, _, more, final, after, done, timed_out = happened[after]
            total, factor = total + factor * more, 0.9 * factor
        assert reward == pytest.approx(total, rel=1e-5)
        assert discount == pytest.approx(0.0 if done and not timed_out else factor, rel=1e-5)
        assert next_obs == final or (done and not timed_out)
        kinds.add((done, timed_out))
    newest = {key for key, (number, *_) in happened.items() if number >= steps - num_steps}
    oldest = {key for key, (number, *_) in happened.items() if number < steps - 40}
    assert seen == happened.keys() - began_late - newest - oldest
    assert kinds == {(False, False), (True, False), (True, True)}
