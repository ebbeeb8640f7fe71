"""The update against stock rsl_rl, returns and formulas against numpy; bad numbers are skipped or undone."""

import math

import numpy as np
import pytest
import torch
from rsl_rl.algorithms import PPO
from support.rollouts import (
    NUM_ACTIONS,
    POISONS,
    SAMPLES,
    SETTINGS,
    STEPS,
    WORLDS,
    assert_same_state,
    copy_rollout,
    make_ppo,
    parameters,
    poison,
    record_rollout,
    shift_policy,
    state_of,
    steps_taken,
)
from support.settings import error_of
from torch import nn

from legged_torque.learning.distribution import GaussianDistribution
from legged_torque.learning.ppo import LOSS_NAMES, OnDevicePPO, cpu_ppo
from legged_torque.learning.ppo.cpu_ppo import run_network


def pair_with_rollout(shift=0.0, **settings):
    """Our and rsl_rl's algorithm with the same weights, the same rollout and the policy moved by ``shift``."""
    ours, stock = make_ppo(**settings), make_ppo(PPO, **settings)
    record_rollout(ours)
    stock.actor.load_state_dict(ours.actor.state_dict())
    stock.critic.load_state_dict(ours.critic.state_dict())
    copy_rollout(ours.storage, stock.storage)
    for alg in (ours, stock):
        shift_policy(alg, shift)
    return ours, stock


def update_both(ours, stock, seed):
    """Update both from the same random order of the samples; return what they report."""
    reports = []
    for alg in (ours, stock):
        torch.manual_seed(seed)
        reports.append(alg.update())
    return reports


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"num_mini_batches": 3},
        {"clip_param": 0.1, "max_grad_norm": 0.05},
        {"use_clipped_value_loss": False, "value_loss_coef": 0.5, "entropy_coef": 0.1},
        {"normalize_advantage_per_mini_batch": True},
        {"optimizer": "adamw"},
        {"schedule": "adaptive"},
        {"obs_normalization": True},
    ],
    ids=lambda settings: ",".join(settings) or "default",
)
def test_updates_equal_those_of_rsl_rl(settings):
    """Three updates of all minibatches give rsl_rl's parameters, Adam moments, learning rate and losses."""
    ours, stock = pair_with_rollout(shift=0.1, **settings)
    before = state_of(ours)
    for seed in range(3):
        our_report, stock_report = update_both(ours, stock, seed)
        assert_same_state(state_of(ours), state_of(stock))
        for name in ("value", "surrogate", "entropy"):
            assert our_report[name] == pytest.approx(stock_report[name], rel=1e-4, abs=1e-6)
        assert our_report["skipped_updates"] == 0
    assert steps_taken(ours) == 3 * ours.num_mini_batches
    assert all(not torch.equal(before[name], value) for name, value in parameters(ours).items())


def test_every_epoch_sees_every_sample_in_a_new_order():
    """Each epoch of an update is one pass over all samples, and no two passes have the same order."""
    alg, order = make_ppo(num_learning_epochs=3), []
    record_rollout(alg)
    names = alg.storage.observations["policy"][..., 0].flatten().clone()  # a random number that tells samples apart
    alg.actor.register_forward_pre_hook(lambda _, inputs: order.append(inputs[0]["policy"][:, 0].clone()))
    alg.update()
    epochs = torch.cat(order).view(3, SAMPLES)
    assert torch.equal(epochs.sort(dim=1).values, names.sort().values.expand(3, -1))
    assert len({tuple(epoch.tolist()) for epoch in epochs}) == 3


def kl_by_hand(alg):
    """Mean KL divergence of the present policy from the one that has acted, from the formula for normals."""
    obs = alg.storage.observations.flatten(0, 1)
    new_mean = alg.actor(obs).detach().double().numpy()
    new_std = np.exp(alg.actor.distribution.log_std_param.detach().double().numpy())
    old_mean, old_std = (p.flatten(0, 1).double().numpy() for p in alg.storage.distribution_params)
    kl = np.log(new_std / old_std) + (old_std**2 + (old_mean - new_mean) ** 2) / (2.0 * new_std**2) - 0.5
    return kl.sum(axis=1).mean()


@pytest.mark.parametrize(
    ("shift", "old_rate", "new_rate"),
    [
        (0.3, 1e-3, 1e-3 / 1.5),
        (0.3, 1.2e-5, 1e-5),
        (0.05, 1e-3, 1e-3),
        (0.02, 1e-3, 1.5e-3),
        (0.02, 9e-3, 1e-2),
        (0.0, 1e-3, 1e-3),
    ],
)
def test_adaptive_learning_rate(shift, old_rate, new_rate):
    """A KL over twice the desired one divides the rate by 1.5, one under half multiplies it, within [1e-5, 1e-2]."""
    ours, stock = pair_with_rollout(
        shift, num_mini_batches=1, schedule="adaptive", desired_kl=0.01, learning_rate=old_rate
    )
    kl = kl_by_hand(ours)
    assert (kl > 0.02) == (new_rate < old_rate) and (0.0 < kl < 0.005 and shift > 0.0) == (new_rate > old_rate)
    report, _ = update_both(ours, stock, seed=0)
    assert report["kl"] == pytest.approx(kl, rel=1e-3, abs=1e-7)
    for alg in (ours, stock):
        assert float(alg.learning_rate) == pytest.approx(new_rate, rel=1e-6)
        assert float(alg.optimizer.param_groups[0]["lr"]) == pytest.approx(new_rate, rel=1e-6)


def test_highest_learning_rate():
    """An adaptive rate rises to the highest one that is allowed, and a higher one falls to it."""
    for old_rate, new_rate in ((1e-3, 1.5e-3), (1.4e-3, 2e-3), (5e-3, 2e-3)):
        alg = make_ppo(num_mini_batches=1, schedule="adaptive", learning_rate=old_rate, max_learning_rate=2e-3)
        record_rollout(alg)
        shift_policy(alg, 0.02)
        alg.update()
        assert float(alg.learning_rate) == pytest.approx(new_rate, rel=1e-6)


@pytest.mark.parametrize(("progress", "left"), [(0.0, 1.0), (0.5, 1.0), (0.75, 0.5), (0.9, 0.2)])
def test_annealing(progress, left):
    """After half of a training a fixed rate and the weight of the entropy fall linearly; an adaptive rate does not."""
    fixed, adaptive = (make_ppo(schedule=name, annealing_start=0.5, entropy_coef=0.1) for name in ("fixed", "adaptive"))
    for alg in (fixed, adaptive):
        record_rollout(alg)
        full, (_, _, entropy, _) = alg.loss()
        alg.set_progress(round(100 * progress), 100)
        assert float(full - alg.loss()[0]) == pytest.approx(-0.1 * (1.0 - left) * float(entropy), abs=1e-5)
    assert float(fixed.learning_rate) == pytest.approx(left * 1e-3)
    assert float(fixed.optimizer.param_groups[0]["lr"]) == float(fixed.learning_rate)
    assert float(adaptive.learning_rate) == pytest.approx(1e-3)


@pytest.mark.parametrize("kind", [OnDevicePPO, cpu_ppo.CpuPPO])
def test_entropy_counts_actions_by_weights(kind):
    """That of a Gaussian is log(std) + (1 + log(2 pi)) / 2 for each action; without weight, the bonus moves no std."""
    alg = make_ppo(kind, entropy_coef=0.1)
    record_rollout(alg)
    weights = torch.linspace(0.0, 1.0, NUM_ACTIONS)
    alg.action_weights.copy_(weights)
    deviations = torch.linspace(0.5, 2.0, NUM_ACTIONS)
    alg.actor.distribution.log_std_param.data.copy_(deviations.log())
    results = []
    for bonus in (0.1, 0.3):
        alg.entropy_weight.fill_(bonus)
        loss, (_, _, entropy, _) = alg.loss()
        results.append((float(loss), torch.autograd.grad(loss, alg.actor.distribution.log_std_param)[0]))
    (small, gradient), (large, larger_gradient) = results
    by_hand = float((weights * (deviations.log() + 0.5 * (1.0 + math.log(2.0 * math.pi)))).sum())
    assert float(entropy) == pytest.approx(by_hand, rel=1e-5)
    assert small - large == pytest.approx(0.2 * by_hand, rel=1e-4)
    torch.testing.assert_close(gradient - larger_gradient, 0.2 * weights, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("share", "factor"), [(1.0, 1.0), (1 / 3, 1 / 1.5)])
def test_adaptive_rate_follows_annealing(share, factor):
    """A divergence that is wanted is too large when a third of it is left to be wanted."""
    alg = make_ppo(num_mini_batches=1, schedule="adaptive", desired_kl=0.01, annealing_start=0.5, learning_rate=1e-3)
    record_rollout(alg)
    shift_policy(alg, 0.05)
    alg.set_progress(1.0 - 0.5 * share * kl_by_hand(alg) / 0.01, 1)
    alg.update()
    assert float(alg.learning_rate) == pytest.approx(1e-3 * factor, rel=1e-6)


@pytest.mark.parametrize("per_mini_batch", [False, True])
def test_returns_and_advantages(per_mini_batch):
    """GAE by a loop in numpy: rewards, values after time-outs, and no credit across the end of an episode."""
    gamma, lam = 0.97, 0.8
    alg = make_ppo(gamma=gamma, lam=lam, normalize_advantage_per_mini_batch=per_mini_batch)
    told, last_obs = record_rollout(alg)
    storage = alg.storage
    values = storage.values.squeeze(-1).double().numpy()
    assert told["time_outs"].any() and (told["dones"] > told["time_outs"]).any()
    with torch.no_grad():
        last_values = alg.critic(last_obs).squeeze(-1).double().numpy()
        seen = alg.critic(storage.observations.flatten(0, 1)).view(STEPS, WORLDS).double().numpy()
    np.testing.assert_allclose(values, seen, rtol=1e-5, atol=1e-6)
    returns = np.zeros((STEPS, WORLDS))
    for world in range(WORLDS):
        advantage, next_value = 0.0, last_values[world]
        for step in reversed(range(STEPS)):
            reward = told["rewards"][step, world]
            if told["time_outs"][step, world]:
                reward += gamma * values[step, world]  # the episode would have gone on from a state as good as this
            if told["dones"][step, world]:
                advantage, next_value = 0.0, 0.0
            advantage = reward + gamma * next_value - values[step, world] + gamma * lam * advantage
            returns[step, world] = advantage + values[step, world]
            next_value = values[step, world]
    advantages = returns - values
    if not per_mini_batch:
        advantages = (advantages - advantages.mean()) / advantages.std(ddof=1)
    np.testing.assert_allclose(storage.returns.squeeze(-1), returns, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(storage.advantages.squeeze(-1), advantages, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"optimizer": "adamm"}, "unknown optimizer 'adamm'; did you mean 'adam'?"),
        ({"num_mini_batches": SAMPLES + 1}, "num_mini_batches is 65, more than the samples of a rollout"),
    ],
)
def test_settings_that_make_no_sense(settings, message):
    """They are refused by name."""
    assert message in error_of(lambda: make_ppo(**settings).allocate())


def test_statistics_of_samples():
    """Samples have the mean and the standard deviation asked for, are normal and independent."""
    torch.manual_seed(0)
    num, mean, log_std = 200_000, [-1.0, 0.0, 3.0], [math.log(0.1), 0.0, math.log(4.0)]
    distribution = GaussianDistribution(3, std_type="log")
    with torch.no_grad():
        distribution.log_std_param.copy_(torch.tensor(log_std))
    distribution.update(torch.tensor(mean).expand(num, 3))
    standard = (distribution.sample().double().numpy() - mean) / np.exp(log_std)
    error = 5.0 / math.sqrt(num)  # five standard errors
    np.testing.assert_allclose(standard.mean(axis=0), 0.0, atol=error)
    np.testing.assert_allclose(standard.std(axis=0), 1.0, atol=error)
    np.testing.assert_allclose(np.corrcoef(standard.T), np.eye(3), atol=error)
    np.testing.assert_allclose((np.abs(standard) < 2.0).mean(axis=0), 0.954500, atol=error)


@pytest.mark.parametrize(("field", "value"), POISONS)
def test_only_the_spoiled_minibatch_is_skipped(field, value):
    """The result equals that of rsl_rl learning from the other minibatches only, moments and counters included."""
    ours = make_ppo()
    record_rollout(ours)
    spoiled = poison(ours.storage, field, value)
    size = SAMPLES // 4
    torch.manual_seed(3)
    minibatches = torch.randperm(SAMPLES).split(size)
    expected = make_ppo(PPO, steps=size, worlds=1, num_mini_batches=1)
    expected.actor.load_state_dict(ours.actor.state_dict())
    expected.critic.load_state_dict(ours.critic.state_dict())
    for samples in minibatches:
        if spoiled not in samples:
            copy_rollout(ours.storage, expected.storage, samples)
            expected.update()
    torch.manual_seed(3)
    report = ours.update()
    assert report["skipped_updates"] == 1
    assert all(math.isfinite(report[name]) for name in LOSS_NAMES)
    assert steps_taken(ours) == 3
    assert_same_state(state_of(ours), state_of(expected))


@pytest.mark.parametrize("per_mini_batch", [False, True])
def test_reward_that_is_not_a_number(per_mini_batch):
    """It spoils the earlier returns of its own world; only if advantages share one normalization, all minibatches."""
    alg = make_ppo(normalize_advantage_per_mini_batch=per_mini_batch, num_mini_batches=16)
    record_rollout(alg, poison=(2, 1))
    spoiled = torch.isnan(alg.storage.returns.squeeze(-1))
    assert spoiled[2, 1] and not spoiled[3:].any() and not spoiled[:, [0, 2, 3]].any()
    before = state_of(alg)
    skipped = alg.update()["skipped_updates"]
    assert 1 <= skipped <= 3 if per_mini_batch else skipped == 16
    for name, value in parameters(alg).items():
        assert torch.isfinite(value).all()
        assert torch.equal(before[name], value) != per_mini_batch


def test_learning_rate_ignores_an_undefined_divergence():
    """A minibatch with observations that are not numbers has no KL and leaves the adaptive learning rate alone."""
    alg = make_ppo(num_mini_batches=1, schedule="adaptive")
    record_rollout(alg)
    poison(alg.storage, "policy", math.nan)
    assert alg.update()["skipped_updates"] == 1
    assert float(alg.learning_rate) == pytest.approx(SETTINGS["learning_rate"], rel=1e-6)


SPOILS = [("rate", math.nan), ("rate", 3e38), ("exp_avg", math.nan), ("exp_avg_sq", -1.0), ("step", -1.0)]
"""The learning rate, one of Adam's moments or a counter of its steps, and what spoils it."""


@pytest.mark.parametrize(("what", "value"), SPOILS)
def test_updates_that_spoil_weights_or_moments_are_undone(what, value):
    """All of the iteration is undone, to the bit, and counted; with good numbers learning goes on as if unspoiled."""
    alg, twin = make_ppo(), make_ppo()
    for each in (alg, twin):
        record_rollout(each, seed=1)
        torch.manual_seed(4)
        each.update()
    good = alg.state_dict()
    of_a_bias = list(alg.optimizer.state.values())[2]
    (alg.learning_rate if what == "rate" else of_a_bias[what]).view(-1)[-1] = value
    before = state_of(alg)
    record_rollout(alg, seed=2)
    report = alg.update()
    assert report["skipped_updates"] == 4
    assert all(math.isfinite(report[name]) for name in LOSS_NAMES)
    for key, value in state_of(alg).items():
        assert torch.equal(value.nan_to_num(), before[key].nan_to_num()), key
    assert all(torch.isfinite(value).all() for value in parameters(alg).values())
    alg.load_state_dict(good)
    alg.learning_rate.fill_(SETTINGS["learning_rate"])
    for each in (alg, twin):
        record_rollout(each, seed=3)
        torch.manual_seed(5)
        assert each.update()["skipped_updates"] == 0
    assert_same_state(state_of(alg), state_of(twin), rtol=0.0, atol=0.0)


def test_undone_first_update():
    """Where there are no moments yet, they are 0 again afterwards, and the next update is the first one."""
    alg, twin = make_ppo(), make_ppo()
    record_rollout(alg, seed=1)
    alg.learning_rate.fill_(math.nan)
    before = {name: value.clone() for name, value in parameters(alg).items()}
    assert alg.update()["skipped_updates"] == 4
    assert all(torch.equal(before[name], value) for name, value in parameters(alg).items())
    assert steps_taken(alg) == 0
    alg.learning_rate.fill_(SETTINGS["learning_rate"])
    for each in (alg, twin):
        record_rollout(each, seed=3)
        torch.manual_seed(5)
        each.update()
    assert_same_state(state_of(alg), state_of(twin), rtol=0.0, atol=0.0)


def test_elu_on_a_cpu():
    """It and its derivative are torch's to a rounding error of 1, also of numbers that are not finite."""
    numbers, found = [-math.inf, -200.0, -1.0, -1e-4, -1e-9, 0.0, 1e-9, 3.0, math.inf, math.nan], []
    for elu in (nn.functional.elu, lambda values: run_network([nn.ELU()], 1.0 * values)):
        values = torch.tensor(numbers, requires_grad=True)
        outputs = elu(values)
        outputs.sum().backward()
        found.append((outputs, values.grad))
    torch.testing.assert_close(*found, rtol=0.0, atol=1.2e-7, equal_nan=True)


@pytest.mark.parametrize("use_onednn", [False, torch.backends.mkldnn.is_available()])
def test_linear_layer_on_a_cpu(monkeypatch, use_onednn):
    """It and its gradients are those of float64 to rounding."""
    monkeypatch.setattr(cpu_ppo, "USE_ONEDNN", use_onednn)
    torch.manual_seed(1)
    layer, inputs, weights = nn.Linear(45, 128), torch.randn(300, 45), torch.randn(300, 128)
    found = []
    for layer_of, dtype in ((lambda values: run_network([layer], values), torch.float32), (layer, torch.float64)):
        layer.to(dtype).zero_grad()
        values = inputs.to(dtype, copy=True).requires_grad_()
        outputs = layer_of(values)
        (weights.to(dtype) * outputs).sum().backward()
        found.append([each.double() for each in (outputs, values.grad, layer.weight.grad, layer.bias.grad)])
    torch.testing.assert_close(*found, rtol=1e-5, atol=2e-5)
