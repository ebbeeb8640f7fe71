"""Runners of small tasks on the CPU."""

import torch

from legged_torque.envs import task_registry
from legged_torque.utils.config import set_by_path

SMALL = {"runner.num_steps_per_env": 4, "algorithm.num_mini_batches": 2, "evaluation.interval": 0}


def build_runner(make_task, name, num_envs=4, seed=0, log_root=None, env=None, **overrides):
    """Build a task and its runner, seeded; ``env`` and ``overrides`` are settings of both by dotted path."""
    _, train_cfg = task_registry.get_cfgs(name)
    for path, value in {**SMALL, **overrides}.items():
        set_by_path(train_cfg, path, value)
    task = make_task(name, num_envs, seed, **(env or {}))
    torch.manual_seed(seed)
    return task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=log_root)[0]


def networks(runner):
    """All parameters of actor and critic."""
    return {**runner.alg.actor.state_dict(prefix="actor."), **runner.alg.critic.state_dict(prefix="critic.")}
