"""All tasks, and what a variant builds on."""

from legged_torque.envs.approaches.multi_head import MultiHeadRobot
from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.envs.approaches.torque_curriculum import TorqueCurriculumRobot
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO, LinearChange
from legged_torque.envs.base.observations import ObservationTerm
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.envs.tasks import (
    A1MultiHeadCfg,
    A1MultiHeadCfgPPO,
    A1TorqueCfg,
    A1TorqueCfgPPO,
    A1TorqueCurriculumCfg,
    A1TorqueCurriculumCfgPPO,
    A1TorqueGravityCfgPPO,
    A1TorqueMultiHeadCfg,
)
from legged_torque.utils.config import Section
from legged_torque.utils.task_registry import task_registry

__all__ = [
    "A1Cfg",
    "A1CfgPPO",
    "A1MultiHeadCfg",
    "A1MultiHeadCfgPPO",
    "A1TorqueCfg",
    "A1TorqueCfgPPO",
    "A1TorqueCurriculumCfg",
    "A1TorqueCurriculumCfgPPO",
    "A1TorqueGravityCfgPPO",
    "A1TorqueMultiHeadCfg",
    "LeggedRobot",
    "LeggedRobotCfg",
    "LeggedRobotCfgPPO",
    "LinearChange",
    "MultiHeadRobot",
    "ObservationTerm",
    "Section",
    "TorqueCurriculumRobot",
    "TorqueRobot",
    "task_registry",
]
