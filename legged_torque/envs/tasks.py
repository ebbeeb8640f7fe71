"""Every task by name: robot x approach x ground, by listing their settings as bases, the approach first."""

from __future__ import annotations

from legged_torque.envs.approaches.multi_head import (
    MultiHeadCfg,
    MultiHeadCfgPPO,
    MultiHeadRobot,
    TorqueMultiHeadCfg,
)
from legged_torque.envs.approaches.torque import TorqueCfg, TorqueCfgPPO, TorqueRobot
from legged_torque.envs.approaches.torque_curriculum import (
    TorqueCurriculumCfg,
    TorqueCurriculumCfgPPO,
    TorqueCurriculumRobot,
)
from legged_torque.envs.approaches.torque_gravity import TorqueGravityCfgPPO
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.utils.task_registry import task_registry

task_registry.register("a1_position", LeggedRobot, A1Cfg(), A1CfgPPO())


class A1TorqueCfg(TorqueCfg, A1Cfg):
    """A1 whose actions are torques."""


class A1TorqueCfgPPO(TorqueCfgPPO, A1CfgPPO):
    """Its training."""


task_registry.register("a1_torque", TorqueRobot, A1TorqueCfg(), A1TorqueCfgPPO())


class A1TorqueGravityCfgPPO(TorqueGravityCfgPPO, A1CfgPPO):
    """Training of ``a1_torque`` from a policy that stands."""


task_registry.register("a1_torque_gravity", TorqueRobot, A1TorqueCfg(), A1TorqueGravityCfgPPO())


class A1TorqueCurriculumCfg(TorqueCurriculumCfg, A1Cfg):
    """A1 with torques that is first rewarded for its nominal pose."""


class A1TorqueCurriculumCfgPPO(TorqueCurriculumCfgPPO, A1CfgPPO):
    """Its training."""


task_registry.register(
    "a1_torque_curriculum", TorqueCurriculumRobot, A1TorqueCurriculumCfg(), A1TorqueCurriculumCfgPPO()
)


class A1TorqueMultiHeadCfg(TorqueMultiHeadCfg, A1Cfg):
    """A1 with positions and torques; the PD part fades to 0."""


class A1MultiHeadCfg(MultiHeadCfg, A1Cfg):
    """A1 with positions and torques; the PD part fades to 0.1."""


class A1MultiHeadCfgPPO(MultiHeadCfgPPO, A1CfgPPO):
    """Training of both."""


task_registry.register("a1_torque_multihead", MultiHeadRobot, A1TorqueMultiHeadCfg(), A1MultiHeadCfgPPO())
task_registry.register("a1_multihead", MultiHeadRobot, A1MultiHeadCfg(), A1MultiHeadCfgPPO())
