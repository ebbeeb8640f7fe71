"""The registry of tasks, and settings that inherit."""

import copy
import zipfile

import pytest
import torch
from support.settings import COMBINATIONS, OTHER_ROBOTS, ROUGH, TASKS, error_of, parse

from legged_torque.envs import TorqueRobot, task_registry
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.utils.config import BaseConfig, to_dict, update_from_dict
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.options import Options
from legged_torque.utils.runs import save_config
from legged_torque.utils.task_registry import TaskRegistry


def test_registered_tasks():
    """The approaches and what combines them are there, each with an experiment of its own."""
    names = task_registry.names()
    assert names == TASKS + COMBINATIONS + ROUGH + OTHER_ROBOTS
    for name in names:
        env_cfg, train_cfg = task_registry.get_cfgs(name)
        assert env_cfg.env.num_actions is None  # follows from the approach and the robot
        assert train_cfg.runner.experiment_name == name


@pytest.mark.parametrize("function", ["get_task_class", "get_cfgs", "make_env"])
def test_unknown_task(function):
    """The nearest task is proposed, and of so many only the nearest are listed."""
    line = error_of(getattr(task_registry, function), "a1-position")
    assert line.startswith("unknown task 'a1-position'; did you mean 'a1_position'? allowed: ")
    assert " others; " in line and len(line) < 300
    assert str(unknown_name("task", "xyz", ["b", "a"])) == "unknown task 'xyz'; allowed: a, b"


def test_a_name_is_given_once():
    """Another task under a name in use is refused, and the first one stays."""
    registry = TaskRegistry()
    registry.register("mine", LeggedRobot, A1Cfg(), A1CfgPPO())
    with pytest.raises(UserError, match="'mine' is a task already"):
        registry.register("mine", TorqueRobot, A1Cfg(), A1CfgPPO())
    assert registry.get_task_class("mine") is LeggedRobot


@pytest.mark.parametrize("name", ["os:getcwd", "os:Nothing", "no_module:Robot", "no:module:Robot"])
def test_a_class_that_is_none(name):
    """The name of a class must lead to one."""
    registry = TaskRegistry()
    registry.register("mine", name, A1Cfg(), A1CfgPPO())
    assert "the class of task 'mine'" in error_of(registry.get_task_class, "mine")


def test_settings_are_independent_copies():
    """Changing what the registry hands out changes neither the registry nor the classes."""
    env_cfg, train_cfg = first = task_registry.get_cfgs("a1_torque")
    before = copy.deepcopy([to_dict(cfg) for cfg in first])
    for cfg in (env_cfg, A1Cfg()):
        cfg.rewards.scales.torques = 1.0
        cfg.commands.ranges.lin_vel_x[0] = -9.0
        cfg.init_state.default_joint_angles["FR_hip_joint"] = 9.0
    train_cfg.actor.hidden_dims.append(1)
    assert [to_dict(cfg) for cfg in task_registry.get_cfgs("a1_torque")] == before
    assert A1Cfg.commands.ranges.lin_vel_x == [-1.0, 1.0]
    assert A1Cfg.init_state.default_joint_angles["FR_hip_joint"] == -0.1


class VariantCfg(A1Cfg):
    """A variant as a user of legged_gym writes it."""

    class control(A1Cfg.control):
        stiffness = 40.0
        new_gain: int = 3

    class rewards(A1Cfg.rewards):
        class scales(A1Cfg.rewards.scales):
            torques = -1e-4
            action_rate = 0.0


def test_variant_is_built(make_task):
    """A registered variant becomes a task with its settings; a reward scale of 0 is no term."""
    registry = TaskRegistry()
    registry.register("variant", LeggedRobot, VariantCfg(), A1CfgPPO())
    env_cfg, _ = registry.get_cfgs("variant", parse("--num_envs=2"))
    task, cfg = registry.make_env("variant", Options(device="cpu"), env_cfg)
    assert task.cfg is cfg is env_cfg and task.num_envs == 2
    assert "action_rate" not in task.reward_names
    reference = make_task("a1_position", 2)
    assert set(reference.reward_names) == {*task.reward_names, "action_rate"}
    torch.testing.assert_close(
        task._compute_torques(torch.zeros(2, 12)), 40.0 * (task.default_dof_pos - task.dof_pos) - 0.5 * task.dof_vel
    )


def test_reward_scale_without_a_term():
    """A new scale that names no term is refused when the task is built."""

    class Cfg(VariantCfg):
        class rewards:
            class scales:
                torqes: float = -1.0

    line = error_of(LeggedRobot, Cfg(), "cpu")
    assert line.startswith("unknown reward term 'torqes'; did you mean 'torques'?")


def test_tuples_are_lists():
    """A variant may write its ranges as tuples: they come back from a file as the lists that they are then."""

    class Variant(BaseConfig):
        limits = (-0.5, 1.0)

    cfg = Variant()
    assert cfg.limits == [-0.5, 1.0]
    update_from_dict(cfg, {"limits": [0.0, 2.0]})
    assert cfg.limits == [0.0, 2.0]


@pytest.mark.parametrize(
    ("task", "decimation", "words", "samples"),
    [
        ("a1_position", 2, [], 64_000),
        ("a1_position", 2, ["--policy_hz=100"], 64_000),
        ("a1_position", 2, ["--set=evaluation.num_samples=20"], 20),
        ("a1_torque_gravity", 4, [], 32_000),
    ],
)
def test_settings_of_a_student(tmp_path, task, decimation, words, samples):
    """Evaluations take as long as at 50 Hz, where a teacher's policy acts at 100 Hz; none starts from pre-training."""
    env_cfg, _ = task_registry.get_cfgs(task)
    env_cfg.control.decimation = decimation
    save_config(tmp_path, {"task": task, "env": to_dict(env_cfg), "train": {}})
    zipfile.ZipFile(tmp_path / "model_2.pt", "w").close()
    teachers = [f"--task={task}", "--preset=student", f"--set=distillation.teachers=[{tmp_path}]"]
    env_cfg, train_cfg = task_registry.get_new_cfgs(parse(*teachers, *words))
    assert (env_cfg.control.decimation, train_cfg.evaluation.num_samples) == (decimation, samples)
    assert train_cfg.distillation.teachers == [str(tmp_path / "model_2.pt")]
    assert train_cfg.pretraining.function == ""


def test_names_of_a_users_own_task():
    """Names in a user's task or in one of its presets are known for every task; a mistake in one is reported."""

    class Cfg(A1CfgPPO):
        class critic:
            class_name = "RNNModel"

        def presets(self):
            return super().presets() | {"cnn": {"critic": {"class_name": "CNNModel"}}}

    registry = TaskRegistry()
    registry.register("theirs", LeggedRobot, A1Cfg(), A1CfgPPO())
    words = parse("--set=critic.class_name=RNNModel")
    assert "unknown critic.class_name 'RNNModel'" in error_of(registry.get_cfgs, "theirs", words)
    registry.register("own", LeggedRobot, A1Cfg(), Cfg())
    for name in ("RNNModel", "CNNModel"):
        _, cfg = registry.get_cfgs("theirs", parse(f"--set=critic.class_name={name}"))
        assert cfg.critic.class_name == name
    _, cfg = registry.get_cfgs("own", words)
    cfg.critic.class_name = "RNModel"
    assert error_of(cfg.import_code).startswith("critic.class_name: ")
