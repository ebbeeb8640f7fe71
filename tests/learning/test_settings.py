"""Names of code in the settings of trainings."""

from support.settings import error_of, parse

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.utils.task_registry import TaskRegistry


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
