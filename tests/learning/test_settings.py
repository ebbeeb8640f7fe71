"""Settings of trainings: what they refuse, and the names of code that they may have."""

import pytest
from support.settings import error_of, get_cfgs, parse

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.utils.task_registry import TaskRegistry


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("algorithm.max_learning_rate=1e-5", "algorithm.learning_rate must be at most algorithm.max_learning_rate"),
        ("pretraining.file=policy.pt", "pretraining.file is set, but nothing starts from it"),
        ("runner.run_name=a/b", "runner.run_name must be a name, not the path 'a/b'"),
        ("actor.activation=relo", "unknown actor.activation 'relo'; did you mean 'relu'?"),
        ("runner.logger=tensorbord", "unknown runner.logger 'tensorbord'; did you mean 'tensorboard'?"),
    ],
)
def test_settings_that_do_not_go_together(change, message):
    """They are refused by name."""
    assert message in error_of(get_cfgs, f"--set={change}")


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
