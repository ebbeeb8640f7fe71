"""Two trainings compared to the bit, iteration by iteration, and gradients of kernels against autograd."""

import torch
from support.on_device import make_runner
from torch.nn.utils import parameters_to_vector

from legged_torque.utils.task_registry import set_seed


def recorded(runner):
    """Copies of the last rollout and of networks and losses after the update."""
    alg, storage = runner.alg, runner.alg.storage
    result = {f"observations {group}": value for group, value in storage.observations.items()}
    result |= {name: getattr(storage, name) for name in ("actions", "rewards", "returns", "advantages")}
    result |= {"actor": parameters_to_vector(alg.actor.parameters()), "losses": alg.losses}
    result |= {"critic": parameters_to_vector(alg.critic.parameters()), "learning rate": alg.learning_rate}
    return {name: value.detach().clone() for name, value in result.items()}


def differences(device, iterations, *words):
    """Train twice, with CUDA graphs and without; return the differences by iteration and name, and the runners.

    The first iteration with graphs runs as it is, the second captures them, the others replay them.
    """
    runners = [make_runner(device, *words, f"--set=runner.capture={capture}") for capture in (False, True)]
    found = {}
    for iteration in range(iterations):
        results = []
        for runner in runners:
            set_seed(iteration)
            runner.learn(1, init_at_random_ep_len=iteration == 0)
            results.append(recorded(runner))
        for name, plain in results[0].items():
            if not torch.equal(plain, results[1][name]) or not torch.isfinite(plain).all():
                found[iteration, name] = float((plain - results[1][name]).abs().max())
    return found, runners


@torch.no_grad()
def gradient_errors(alg):
    """How far the kernels' gradients of the chosen samples are from autograd's, in parts of their norm.

    Nothing has changed afterwards.
    """
    state, rate, losses = alg.tensors(), alg.learning_rate, alg.losses
    tensors = [*state, rate, losses]
    before = [tensor.clone() for tensor in tensors]
    alg.update_minibatch()
    found = [gradient.clone() for gradient in alg.gradients()]
    for tensor, value in zip(tensors, before, strict=True):
        tensor.copy_(value)
    alg.round_weights()
    alg.optimizer.zero_grad()
    with torch.enable_grad():
        alg.loss()[0].backward()
    exact = parameters_to_vector(parameter.grad for parameter in [*alg.actor.parameters(), *alg.critic.parameters()])
    if alg.mirrored:
        exact = alg.mirrored.averaged(exact)
    sizes = [sum(parameter.numel() for parameter in network.parameters()) for network in (alg.actor, alg.critic)]
    parts = zip(parameters_to_vector(found).split(sizes), exact.split(sizes), strict=True)
    errors = (float((ours - expected).norm() / expected.norm()) for ours, expected in parts)
    return dict(zip(("actor", "critic"), errors, strict=True))
