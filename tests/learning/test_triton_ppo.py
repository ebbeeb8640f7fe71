"""Acting and learning in few kernels against torch's autograd, torch's Adam and rsl_rl, in Triton's interpreter.

The interpreter runs kernels on the CPU with the numbers' own precision: matrix products of float32 are exact there.
"""

import os

import pytest
import torch
from support.rollouts import POISONS, SIZES, make_ppo, parameters, poison, record_rollout, steps_taken
from support.settings import build_runner, networks
from support.wide_ppo import NARROW, assert_steps_are_those_of_torch, build, choose

from legged_torque.learning.ppo import LOSS_NAMES, OnDevicePPO, has_kernels
from legged_torque.learning.ppo.cpu_ppo import CpuPPO

pytest.importorskip("triton", reason="Triton is there for Linux only")
if os.environ.get("TRITON_INTERPRET") != "1":
    pytest.skip("Triton's interpreter is for machines without a GPU: CUDA_VISIBLE_DEVICES=", allow_module_level=True)
from legged_torque.learning.ppo.triton.triton_ppo import TritonPPO


def make(kind=TritonPPO, **settings):
    """An algorithm that could have kernels."""
    assert has_kernels(build(OnDevicePPO, **settings))
    return build(kind, **settings)


def pair(seed=3, **settings):
    """The same algorithm with torch's operations and with kernels, after the same rollout."""
    plain, fused = make(OnDevicePPO, **settings), make(**settings)
    record_rollout(plain, seed)
    record_rollout(fused, seed)
    return plain, fused


KINDS = [{}, {"multi_head": True, "symmetric": "images"}]


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_rollout_is_that_of_rsl_rl(kind):
    """Actions, their probabilities, values, returns and advantages (GAE)."""
    plain, fused = pair(**kind)
    for name in ("actions", "actions_log_prob", "values", "rewards", "dones", "returns", "advantages"):
        actual, expected = getattr(fused.storage, name), getattr(plain.storage, name)
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4, msg=lambda m, n=name: f"{n}: {m}")
    for name in SIZES:
        assert torch.equal(fused.storage.observations[name], plain.storage.observations[name])
    torch.testing.assert_close(fused.action_std(), plain.action_std()[0])


EQUIVARIANT = {"multi_head": True, "symmetric": "networks"}
SCALAR = {"std_type": "scalar", "use_clipped_value_loss": False}


@pytest.mark.parametrize("kind", [{}, KINDS[1] | SCALAR, EQUIVARIANT], ids=str)
def test_gradients_are_those_of_autograd(kind):
    """Of all parameters, for a policy that has moved since it acted, so that ratios and values are clipped too."""
    settings = {"max_grad_norm": 1e9, "clip_param": 0.02, "learning_rate": 1e-2, "entropy_coef": 0.1, **kind}
    algorithms = plain, fused = pair(**settings)
    for alg in algorithms:
        alg.action_weights.copy_(torch.linspace(0.0, 1.0, len(alg.action_weights)))
    for round_number in range(2):
        choose(algorithms, round_number)
        plain.losses.zero_()
        fused.losses.zero_()
        plain.update_minibatch()
        fused.update_minibatch()
        gradients = dict(zip(parameters(fused), fused.gradients(), strict=True))
        expected = {f"actor.{name}": p.grad for name, p in plain.actor.named_parameters()}
        expected |= {f"critic.{name}": p.grad for name, p in plain.critic.named_parameters()}
        for name, gradient in gradients.items():
            scale = float(expected[name].abs().max())
            torch.testing.assert_close(
                gradient, expected[name], rtol=2e-3, atol=2e-4 * scale, msg=lambda m, n=name: f"{n}: {m}"
            )
        torch.testing.assert_close(fused.losses, plain.losses, rtol=2e-4, atol=1e-5)
        with torch.no_grad():  # errors do not add up
            for own, other in zip(parameters(fused).values(), parameters(plain).values(), strict=True):
                own.copy_(other)
        fused.round_weights()
    surrogates = []
    for plain.clip_param in (0.02, 10.0):
        surrogates.append(float(plain.loss()[1][LOSS_NAMES.index("surrogate")]))
    assert surrogates[0] != pytest.approx(surrogates[1], rel=1e-3)  # ratios have been clipped


@pytest.mark.parametrize("optimizer", ["adam", "adamw"])
def test_steps_are_those_of_torch(optimizer):
    """Those of torch's Adam and AdamW."""
    alg = make(optimizer=optimizer, max_grad_norm=0.05)
    assert_steps_are_those_of_torch(alg, alg.update_minibatch, rtol=1e-5, atol=1e-7)


def test_learning_rate_follows_the_divergence():
    """As without fused kernels: after the policy has moved far, it falls by 1.5, annealed too, and its bounds hold."""
    algorithms = pair(sizes=NARROW, schedule="adaptive", learning_rate=1e-2, desired_kl=0.01, annealing_start=0.5)
    for progress in (1, 3):
        choose(algorithms, progress)
        for alg in algorithms:
            alg.set_progress(progress, 4)
        algorithms[0].update_minibatch()
        algorithms[1].update_minibatch()
        assert float(algorithms[1].learning_rate) == pytest.approx(float(algorithms[0].learning_rate), rel=1e-6)
    assert float(algorithms[1].learning_rate) < 1e-2


def test_updates_are_those_of_torch():
    """Whole updates learn from the same samples in the same order: rates follow each minibatch's divergence."""
    algorithms = plain, fused = pair(sizes=NARROW, schedule="adaptive", learning_rate=1e-3, desired_kl=0.01)
    for alg in algorithms:
        torch.manual_seed(5)
        assert alg.update()["skipped_updates"] == 0.0
    assert steps_taken(plain) == steps_taken(fused) == plain.num_learning_epochs * plain.num_mini_batches > 2
    for own, other in zip(parameters(fused).values(), parameters(plain).values(), strict=True):
        torch.testing.assert_close(own, other, rtol=1e-3, atol=2e-5)


def learn(alg, firsts):
    """Learn from minibatches that begin at these samples of a rollout."""
    for first in firsts:
        alg.indices.copy_(torch.arange(first, first + alg.batch_size))
        alg.update_minibatch()


@pytest.mark.parametrize(("field", "value"), POISONS[5:6])
def test_a_minibatch_that_is_skipped_leaves_nothing_behind(field, value):
    """It is counted, and the next one is learned from as if the one before had never been, to the bit."""
    spoiled, twin = make(sizes=NARROW), make(sizes=NARROW)
    record_rollout(spoiled)
    record_rollout(twin)
    learn(twin, [60])
    poison(spoiled.storage, field, value, step=0, world=2)
    learn(spoiled, [0, 60])
    assert [float(alg.losses[-1]) for alg in (spoiled, twin)] == [1.0, 0.0]
    assert all(map(torch.equal, spoiled.tensors(), twin.tensors()))


def test_the_critic_learns_alone():
    """While a pre-trained policy stays, only the critic's parameters move."""
    alg = make(sizes=NARROW)
    record_rollout(alg)
    alg.warm_up_iterations = 1
    alg.set_progress(0, 2)
    before = {name: value.clone() for name, value in parameters(alg).items()}
    choose([alg], 0)
    alg.update_minibatch()
    for name, value in parameters(alg).items():
        assert torch.equal(value, before[name]) == name.startswith("actor")


@pytest.mark.parametrize("kind", [OnDevicePPO, TritonPPO])
def test_checkpoints_go_both_ways(kind):
    """Torch and the kernels continue from a checkpoint of either, and agree afterwards."""
    first = make(kind, sizes=NARROW)
    record_rollout(first)
    choose([first], 0)
    first.update_minibatch()
    plain, fused = make(OnDevicePPO, seed=8, sizes=NARROW), make(seed=9, sizes=NARROW)
    for alg in (plain, fused):
        alg.load_state_dict(first.state_dict())
        record_rollout(alg, 4)
    assert steps_taken(plain) == steps_taken(fused) == 1
    choose([plain, fused], 1)
    plain.update_minibatch()
    fused.update_minibatch()
    for own, other in zip(parameters(fused).values(), parameters(plain).values(), strict=True):
        torch.testing.assert_close(own, other, rtol=1e-3, atol=2e-5)


def own(part):
    """Make a part one of a user, with methods that kernels do not know."""
    part.__class__ = type("Own", (type(part),), {})


WITHOUT = {
    "activation": lambda alg: alg.actor.mlp.__setitem__(1, torch.nn.Tanh()),
    "fixed deviation": lambda alg: alg.actor.distribution.log_std_param.requires_grad_(False),
    "losses": own,
    "model": lambda alg: own(alg.critic),
    "distribution": lambda alg: own(alg.actor.distribution),
}


def test_what_has_no_kernels_is_left_to_torch():
    """Algorithms with other parts are known beforehand; torch's operations work without mixed precision."""
    for name, change in WITHOUT.items():
        alg = make_ppo()
        assert has_kernels(alg)
        change(alg)
        assert not has_kernels(alg), name
    for settings in ({"obs_normalization": True}, {"normalize_advantage_per_mini_batch": True}):
        assert not has_kernels(make_ppo(**settings))
    alg = make(OnDevicePPO, symmetric="images", use_mixed_precision=True)
    assert alg.product_dtype == torch.float32
    alg.symmetry.use_mirror_loss = True
    assert not has_kernels(alg)


def test_a_training_with_kernels(make_task, tmp_path, monkeypatch):
    """Where there are kernels, the same settings train with them, and a checkpoint goes on without."""

    def new_runner(**settings):
        small = {"actor.hidden_dims": [8, 8], "actor.head_hidden_dims": [8], "critic.hidden_dims": [8]}
        small |= {"runner.logger": "none", "algorithm.use_mixed_precision": False, "algorithm.num_learning_epochs": 1}
        return build_runner(make_task, "a1_torque_multihead", 2, log_root=tmp_path, **small, **settings)

    with monkeypatch.context() as patch:
        patch.setattr("legged_torque.learning.ppo.has_triton", lambda device: True)
        patch.setattr("legged_torque.learning.ppo.triton.triton_ppo.can_multiply", lambda dtype, device: True)
        runner = new_runner()
    before = {name: value.clone() for name, value in networks(runner).items()}
    runner.learn(1)
    assert type(runner.alg) is TritonPPO and steps_taken(runner.alg) == 2
    assert not any(torch.equal(value, before[name]) for name, value in networks(runner).items())
    plain = new_runner()
    plain.load(f"{runner.log_dir}/model_1.pt")
    assert type(plain.alg) is CpuPPO and plain.current_learning_iteration == 1
    assert all(torch.equal(value, networks(runner)[name]) for name, value in networks(plain).items())
    plain.learn(1)
