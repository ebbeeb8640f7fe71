"""Names of all tasks, settings by a command line, and runners of small tasks on the CPU."""

import pytest
import torch

from legged_torque.envs import A1TorqueCfg, task_registry
from legged_torque.motors.config import DelayCfg
from legged_torque.utils.cli import TRAINING, Parser, add_options, add_task_args, options_of
from legged_torque.utils.config import set_by_path
from legged_torque.utils.errors import UserError

TASKS = ["a1_position", "a1_torque", "a1_torque_gravity", "a1_torque_curriculum", "a1_torque_multihead", "a1_multihead"]
COMBINATIONS = ["a1_torque_curriculum_multihead", "a1_multihead_two_rates", "a1_torque_damped"]
COMBINATIONS += ["a1_torque_gravity_curriculum", "a1_torque_gravity_multihead", "a1_torque_curriculum_high"]
COMBINATIONS += ["a1_variable_stiffness", "a1_decap", "a1_sata"]
ROUGH = [f"a1_rough_{name[3:]}{scan}" for name in TASKS + COMBINATIONS for scan in ("", "_scan")]
APPROACHES = ["position", "torque", "torque_gravity", "torque_curriculum", "torque_multihead", "multihead"]
APPROACHES += ["torque_curriculum_multihead", "multihead_two_rates"]  # those that combine with every robot
OTHER_ROBOTS = []  # their tasks, in the order of their registration
for robot in ("anymal_c", "g1", "go1", "go2"):
    OTHER_ROBOTS += [f"{robot}_{approach}" for approach in APPROACHES]
    OTHER_ROBOTS += [f"{robot}_rough_{approach}{scan}" for approach in APPROACHES for scan in ("", "_scan")]


class BusCfg(A1TorqueCfg):
    """An A1 whose delay has a name of its own."""

    class motors:
        chain = ["bus", "ideal"]

        class bus(DelayCfg):
            pass


def parse(*words):
    """The options that train.py makes of a command line, on the CPU."""
    parser = Parser("test")
    add_task_args(parser)
    add_options(parser, *TRAINING)
    return options_of(parser.parse_args(["--device=cpu", *words]))


def get_cfgs(*words, task="a1_position", run_config=None):
    """A task's settings, changed by a command line."""
    return task_registry.get_cfgs(task, parse(*words), run_config)


def error_of(function, *args, **kwargs):
    """The line with which a mistake is refused."""
    with pytest.raises(UserError) as error:
        function(*args, **kwargs)
    assert "\n" not in str(error.value)
    return str(error.value)


def torques_in_torch(task):
    """Let a task compute torques in torch, with a launch per physics step, as tasks do that name no Warp function."""
    compute = task._compute_torques
    task._compute_torques = lambda actions: compute(actions)


def get(section, path):
    """A setting by its dotted path."""
    for key in path.split("."):
        section = section[key] if isinstance(section, dict) else getattr(section, key)
    return section


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
