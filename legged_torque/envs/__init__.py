"""Every task, by name."""

from legged_torque.envs.approaches.multi_head import (
    A1MultiHeadCfg,
    A1MultiHeadCfgPPO,
    A1TorqueMultiHeadCfg,
    A1TorqueMultiHeadCfgPPO,
    MultiHeadRobot,
)
from legged_torque.envs.approaches.torque import A1TorqueCfg, A1TorqueCfgPPO, TorqueRobot
from legged_torque.envs.approaches.torque_curriculum import (
    A1TorqueCurriculumCfg,
    A1TorqueCurriculumCfgPPO,
    TorqueCurriculumRobot,
)
from legged_torque.envs.approaches.torque_gravity import A1TorqueGravityCfg, A1TorqueGravityCfgPPO
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.utils.task_registry import task_registry

task_registry.register("a1_position", LeggedRobot, A1Cfg(), A1CfgPPO())
task_registry.register("a1_torque", TorqueRobot, A1TorqueCfg(), A1TorqueCfgPPO())
task_registry.register("a1_torque_gravity", TorqueRobot, A1TorqueGravityCfg(), A1TorqueGravityCfgPPO())
task_registry.register(
    "a1_torque_curriculum", TorqueCurriculumRobot, A1TorqueCurriculumCfg(), A1TorqueCurriculumCfgPPO()
)
task_registry.register("a1_torque_multihead", MultiHeadRobot, A1TorqueMultiHeadCfg(), A1TorqueMultiHeadCfgPPO())
task_registry.register("a1_multihead", MultiHeadRobot, A1MultiHeadCfg(), A1MultiHeadCfgPPO())
