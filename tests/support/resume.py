"""Trainings in this process that are saved and resumed."""

from pathlib import Path

import torch
from support.reproducible import values
from support.settings import parse

from legged_torque.envs import task_registry
from legged_torque.utils.config import to_dict
from legged_torque.utils.task_registry import set_seed

WORLDS = 6
WORDS = ["--task=a1_torque_multihead", f"--num_envs={WORLDS}", "--perturbation=low", "--logger=none", "--seed=3"]
WORDS += ["--set=runner.num_steps_per_env=4", "--set=algorithm.num_mini_batches=2", "--set=runner.save_interval=1"]
WORDS += ["--set=actor.hidden_dims=[8, 8]", "--set=actor.head_hidden_dims=[8]", "--set=critic.hidden_dims=[8]"]
WORDS += ["--set=evaluation.interval=24", "--set=evaluation.num_samples=60", "--set=env.episode_length_s=0.2"]
WORDS += ["--set=evaluation.also=[high]", "--set=evaluation.also_from=48"]
WORDS += ["--set=env.history_length=2", "--set=motors.delay.range=[0, 3]"]
WORDS += ["--set=motors.delay.jitter=5", "--set=motors.delay.loss=0.2"]
WORDS += ["--set=sensing.delay.range=[0, 3]", "--set=sensing.delay.jitter=2", "--set=sensing.delay.loss=0.2"]


def start(root, *words):
    """The runner that train.py would build, in a folder of runs ``root``."""
    options = parse(*WORDS, *words)
    if options.resume:
        run = task_registry.load_run(options)
        env_cfg, train_cfg, options.load_run = run.env_cfg, run.train_cfg, str(run.folder)
    else:
        env_cfg, train_cfg = task_registry.get_cfgs(options.task, options)
    set_seed(train_cfg.seed)
    env, _ = task_registry.make_env(options.task, options, env_cfg)
    runner, _ = task_registry.make_alg_runner(env, options.task, options, train_cfg, root)
    return runner


def begin(root, *words):
    """The runner of a new run."""
    runner = start(root, *words)
    options = parse(*WORDS, *words)
    env_cfg, train_cfg = map(to_dict, task_registry.get_cfgs(options.task, options))
    runner.claim_log_dir({"task": options.task, "env": env_cfg, "train": train_cfg})
    return runner


def train(root, iterations, *words):
    """Train from the start, and return the runner."""
    runner = begin(root, *words)
    runner.learn(iterations, init_at_random_ep_len=True)
    return runner


def content(runner, iterations):
    """The contents of a run's checkpoint by name, without times."""
    file = Path(runner.log_dir) / f"model_{iterations}.pt"
    return dict(values(torch.load(file, weights_only=True)))
