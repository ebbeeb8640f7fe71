"""Algorithms with small networks, and rollouts of random numbers for them."""

import math

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from legged_torque.learning.distribution import GaussianDistribution
from legged_torque.learning.ppo import OnDevicePPO

STEPS, WORLDS, NUM_ACTIONS = 16, 4, 3
SAMPLES = STEPS * WORLDS
SIZES = {"policy": 5, "critic": 7}
SETTINGS = {
    "num_learning_epochs": 1,
    "num_mini_batches": 4,
    "gamma": 0.99,
    "lam": 0.95,
    "learning_rate": 1e-3,
    "schedule": "fixed",
}

POISONS = [
    ("advantages", math.nan),
    ("advantages", math.inf),
    ("returns", math.nan),
    ("returns", 1e30),  # all gradients are finite, their norm is not
    ("actions", math.nan),
    ("policy", math.nan),
    ("critic", math.nan),
    ("critic", -math.inf),
]
"""Fields of a rollout, and what spoils a minibatch with them."""


def random_obs(num=WORLDS):
    """Observations of both groups, standard normal."""
    return TensorDict({name: torch.randn(num, size) for name, size in SIZES.items()}, [num])


def make_ppo(kind=OnDevicePPO, steps=STEPS, worlds=WORLDS, seed=0, obs_normalization=False, **settings):
    """An algorithm with small networks, and room for a rollout of ``steps`` x ``worlds``."""
    torch.manual_seed(seed)
    distribution = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "log"}
    if kind is not PPO:
        distribution["class_name"] = GaussianDistribution
    obs, groups = random_obs(worlds), {"actor": ["policy"], "critic": ["critic"]}
    actor = MLPModel(obs, groups, "actor", NUM_ACTIONS, [16, 16], "elu", obs_normalization, distribution)
    critic = MLPModel(obs, groups, "critic", 1, [16, 16], "elu", obs_normalization)
    storage = RolloutStorage("rl", worlds, steps, obs, [NUM_ACTIONS])
    return kind(actor, critic, storage, **{**SETTINGS, **settings})


def record_rollout(alg, seed=1, poison=None):
    """Let the algorithm act for one rollout of random numbers; return rewards and dones, and the last observations."""
    torch.manual_seed(seed)
    num, device = alg.storage.num_envs, alg.device
    received = {"rewards": [], "dones": [], "time_outs": []}
    for step in range(alg.storage.num_transitions_per_env):
        obs = random_obs(num).to(device)
        alg.act(obs)
        rewards = torch.randn(num)
        if poison is not None and step == poison[0]:
            rewards[poison[1]] = math.nan
        dones = torch.rand(num) < 0.3
        time_outs = dones & (torch.rand(num) < 0.5)
        for obs_group in obs.values():
            obs_group.fill_(math.nan)  # the task reuses its buffers: a rollout that kept no copy is spoiled
        extras = {"time_outs": time_outs.to(device)}
        alg.process_env_step(random_obs(num).to(device), rewards.to(device), dones.to(device), extras)
        for name, value in (("rewards", rewards), ("dones", dones), ("time_outs", time_outs)):
            received[name].append(value.double().numpy())
    last_obs = random_obs(num).to(device)
    alg.compute_returns(last_obs)
    return {name: np.stack(values) for name, values in received.items()}, last_obs


def copy_rollout(source, target, samples=None):
    """Give ``target`` the stored rollout of ``source``, or only some of its samples, each as a step of one world."""

    def put(old, new):
        new.copy_(old if samples is None else old.flatten(0, 1)[samples].unsqueeze(1))

    for name in SIZES:
        put(source.observations[name], target.observations[name])
    for name in ("actions", "rewards", "dones", "values", "actions_log_prob", "returns", "advantages"):
        put(getattr(source, name), getattr(target, name))
    target.distribution_params = tuple(torch.zeros(*target.actions.shape) for _ in source.distribution_params)
    for old, new in zip(source.distribution_params, target.distribution_params, strict=True):
        put(old, new)
    target.step = target.num_transitions_per_env


def poison(storage, field, value, step=5, world=2):
    """Spoil one sample of a stored rollout; return its number in the flattened rollout."""
    tensor = storage.observations[field] if field in SIZES else getattr(storage, field)
    tensor[step, world, 0] = value
    return step * storage.num_envs + world


def parameters(alg):
    """All parameters, actor's and critic's, by name."""
    models = {"actor": alg.actor, "critic": alg.critic}
    return {f"{key}.{name}": p.detach() for key, model in models.items() for name, p in model.named_parameters()}


def state_of(alg):
    """Copies of everything that an update changes: networks, Adam's moments and step counters, learning rate."""
    models = {**alg.actor.state_dict(prefix="actor."), **alg.critic.state_dict(prefix="critic.")}
    result = {name: value.clone() for name, value in models.items()}
    for index, entry in alg.optimizer.state_dict()["state"].items():
        result |= {f"adam.{index}.{name}": torch.as_tensor(value).clone() for name, value in entry.items()}
    return result | {"lr": torch.as_tensor(alg.learning_rate).clone()}


def steps_taken(alg):
    """The step counters of Adam, which must all agree."""
    (count,) = {int(entry["step"]) for entry in alg.optimizer.state_dict()["state"].values()}
    return count


def assert_same_state(actual, expected, rtol=2e-5, atol=2e-7):
    """Compare two :func:`state_of`."""
    assert actual.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(
            actual[name], value, rtol=rtol, atol=atol, check_dtype=False, msg=lambda m, n=name: f"{n}: {m}"
        )


def shift_policy(alg, amount):
    """Move the policy away from the one that has acted, as earlier updates would."""
    with torch.no_grad():
        alg.actor.mlp[-1].bias += amount
        alg.actor.distribution.log_std_param += amount
