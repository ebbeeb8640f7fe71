"""Simulators, tasks and trainings on a device, results of their steps, and comparisons of trainings to the bit."""

import contextlib
import gc

import numpy as np
import torch
import warp as wp
from support.fused import assert_alike, compiled, draw_states, put
from support.settings import parse
from torch.nn.utils import parameters_to_vector

from legged_torque import RESOURCES_DIR
from legged_torque.envs import task_registry
from legged_torque.sim.registry import make_engine
from legged_torque.utils.mjcf import read_spec
from legged_torque.utils.task_registry import set_seed


def make_robot(name, edit=None):
    """The model of a robot that comes with the package, on a plane, changed by a function of its specification."""
    spec = read_spec(RESOURCES_DIR / f"robots/{name}/{name}.xml")
    if edit is not None:
        edit(spec)
    return compiled(spec)


def make_sim(model, num, device, engine="fused", **settings):
    """An engine whose solver converges."""
    return make_engine(engine, model, num, device, 100, 50, **settings)


def results(sim):
    """Velocities, positions, contact counts and contact forces after a step, as ``assert_alike`` takes them."""
    tensors = (sim.qvel, sim.qpos, sim.contact_found, sim.contact_force)
    return [tensor.double().cpu().numpy() for tensor in tensors]


def step(sim, states):
    """The same after one step from some states."""
    put(sim, states)
    sim.step()
    return results(sim)


def assert_move_as_alone(model, states, device, *numbers, prepare=lambda sim: None):
    """Assert that the first so many worlds of many move to the bit as they do by themselves."""
    together = None
    for number in (len(states["qpos"]), *numbers):
        sim = make_sim(model, number, device)
        prepare(sim)
        found = step(sim, {name: values[:number] for name, values in states.items()})
        together = together or found
        for ours, theirs in zip(found, together, strict=True):
            np.testing.assert_array_equal(ours, theirs[:number])


def thrown(model, num, seed=0):
    """States of a robot that was thrown on the floor, in proportion to its height."""
    height = model.key_qpos[0][2]
    return draw_states(model, num, (0.15 * height, height), seed)


def assert_matches(model, states, actual, expected):
    """Compare results as ``assert_alike`` does, except in worlds where a contact only just touches: 1% at most."""
    alike = (actual[2] == expected[2]).all(axis=1)
    assert alike.mean() >= 0.99, alike.mean()
    chosen = {name: values[alike] for name, values in states.items()}
    assert_alike(model, chosen, *([values[alike] for values in result] for result in (actual, expected)))


def make_env(device, *words):
    """The task of a command line, and the settings of its training."""
    options = parse(*words, f"--device={device}")
    env_cfg, train_cfg = task_registry.get_cfgs(options.task, options)
    set_seed(train_cfg.seed)
    return task_registry.make_env(options.task, options, env_cfg)[0], train_cfg


def make_runner(device, *words, log_root=None):
    """The runner of a command line, with the task that it trains."""
    env, train_cfg = make_env(device, *words)
    return task_registry.make_alg_runner(env, train_cfg=train_cfg, log_root=log_root)[0]


def use_graphs(env, on):
    """Choose whether control steps of a task replay as a CUDA graph."""
    env.step_graph.enabled = on


@contextlib.contextmanager
def no_waiting(device):
    """Let torch refuse operations that wait for a GPU."""
    if torch.device(device).type != "cuda":
        yield
        return
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def used_memory(device):
    """Bytes that torch and Warp hold of a GPU's memory; 0 of a CPU's."""
    if torch.device(device).type != "cuda":
        return 0
    gc.collect()
    of_warp = wp.get_mempool_used_mem_current(device) if wp.is_mempool_supported(device) else 0
    return torch.cuda.memory_allocated(device) + of_warp


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
