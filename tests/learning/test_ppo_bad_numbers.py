"""Updates from numbers that are not finite are skipped or undone."""

import math

import pytest
import torch
from rsl_rl.algorithms import PPO
from support.rollouts import (
    POISONS,
    SAMPLES,
    SETTINGS,
    assert_same_state,
    copy_rollout,
    make_ppo,
    parameters,
    poison,
    record_rollout,
    state_of,
    steps_taken,
)

from legged_torque.learning.ppo import LOSS_NAMES


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
