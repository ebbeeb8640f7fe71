"""Networks for PPO's kernels, with layers wider than a tile, no multiple of one, and no power of two."""

import copy

import torch
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from support.rollouts import SETTINGS, parameters, random_obs, record_rollout

from legged_torque.learning.distribution import GaussianDistribution
from legged_torque.learning.multi_head import MultiHeadModel

STEPS, WORLDS, NUM_ACTIONS = 3, 40, 6
WIDE, NARROW = ([72, 136], [200, 24, 16]), ([24], [40])  # hidden layers of actor and critic
MIRROR = {  # an order that is its own inverse, and signs
    "policy": ([1, 0, 2, 4, 3], [1.0, 1.0, -1.0, 1.0, 1.0]),
    "critic": ([1, 0, 2, 4, 3, 5, 6], [1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0]),
    "actions": ([1, 0, 2, 4, 3, 5], [-1.0, -1.0, 1.0, 1.0, 1.0, -1.0]),  # positions and torques each by themselves
}


def mirrored(name, values):
    """The mirror image of observations or actions. Shape: (samples, size)."""
    order, signs = MIRROR[name]
    return values[:, order] * torch.tensor(signs)


class Mirrored:
    """As much of a task as learning from mirror images needs."""

    def __init__(self, device):
        self.maps = {
            name: (torch.tensor(order, device=device), torch.tensor(signs, device=device))
            for name, (order, signs) in MIRROR.items()
        }
        self.mirror = lambda name, values: values[:, self.maps[name][0]] * self.maps[name][1]
        self.mirror.maps = self.maps


def build(kind, device="cpu", multi_head=False, symmetric="", seed=0, std_type="log", sizes=WIDE, **settings):
    """An algorithm of a kind, which gets actor, critic, storage and settings.

    ``symmetric``: "images" to learn from mirror images, or "networks" that are equivariant.
    """
    torch.manual_seed(seed)
    distribution = {"class_name": GaussianDistribution, "init_std": 0.7, "std_type": std_type}
    obs, groups = random_obs(WORLDS).to(device), {"actor": ["policy"], "critic": ["critic"]}
    arguments = (obs, groups, "actor", NUM_ACTIONS, sizes[0], "elu", False, distribution)
    actor = MultiHeadModel(*arguments, head_hidden_dims=[40]) if multi_head else MLPModel(*arguments)
    critic = MLPModel(obs, groups, "critic", 1, sizes[1], "elu")
    storage = RolloutStorage("rl", WORLDS, STEPS, obs, [NUM_ACTIONS], device)
    if symmetric:
        function = "legged_torque.envs.base.symmetry:with_mirror_images"
        settings["symmetry_cfg"] = {"data_augmentation_func": function, "use_data_augmentation": True}
        settings["symmetry_cfg"] |= {"use_mirror_loss": False, "env": Mirrored(device)}
        settings["symmetry_cfg"]["use_equivariant_networks"] = symmetric == "networks"
    return kind(actor, critic, storage, **{**SETTINGS, "device": device, **settings})


def choose(algorithms, seed):
    """Let all algorithms learn from the same samples next."""
    order = torch.randperm(STEPS * WORLDS, generator=torch.Generator().manual_seed(seed))
    for alg in algorithms:
        alg.indices.copy_(order[: alg.batch_size])


def assert_steps_are_those_of_torch(alg, update, rtol, atol):
    """Compare updates with torch's optimizer in float64, given the same gradients, clipped to 0.05 as torch clips."""
    models = (copy.deepcopy(alg.actor).double(), copy.deepcopy(alg.critic).double())
    theirs = [*models[0].parameters(), *models[1].parameters()]
    reference = type(alg.optimizer)(theirs, lr=1e-3)
    record_rollout(alg)
    for number in range(2):
        choose([alg], number)
        update()
        for parameter, gradient in zip(theirs, alg.gradients(), strict=True):
            parameter.grad = gradient.double()
        for model in models:
            torch.nn.utils.clip_grad_norm_(model.parameters(), 0.05)
        reference.step()
    for own, other in zip(parameters(alg).values(), theirs, strict=True):
        torch.testing.assert_close(own.double(), other, rtol=rtol, atol=atol)
