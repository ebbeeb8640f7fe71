"""Every task by name: robot x approach x ground, by listing their settings as bases, the approach first."""

from __future__ import annotations

from legged_torque.envs.approaches import multi_head, torque, torque_curriculum, torque_gravity
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.utils.task_registry import task_registry


class A1TorqueCfg(torque.TorqueCfg, A1Cfg):
    """A1 whose actions are torques."""


class A1TorqueCfgPPO(torque.TorqueCfgPPO, A1CfgPPO):
    """Its training."""


class A1TorqueGravityCfgPPO(torque_gravity.TorqueGravityCfgPPO, A1CfgPPO):
    """Training of ``a1_torque`` from a policy that stands."""


class A1TorqueCurriculumCfg(torque_curriculum.TorqueCurriculumCfg, A1Cfg):
    """A1 with torques that is first rewarded for its nominal pose."""


class A1TorqueCurriculumCfgPPO(torque_curriculum.TorqueCurriculumCfgPPO, A1CfgPPO):
    """Its training."""


class A1TorqueMultiHeadCfg(multi_head.TorqueMultiHeadCfg, A1Cfg):
    """A1 with positions and torques; the PD part fades to 0."""


class A1MultiHeadCfg(multi_head.MultiHeadCfg, A1Cfg):
    """A1 with positions and torques; the PD part fades to 0.1."""


class A1MultiHeadCfgPPO(multi_head.MultiHeadCfgPPO, A1CfgPPO):
    """Training of both."""


for name, robot, env_cfg, train_cfg in (
    ("a1_position", LeggedRobot, A1Cfg, A1CfgPPO),
    ("a1_torque", torque.TorqueRobot, A1TorqueCfg, A1TorqueCfgPPO),
    ("a1_torque_gravity", torque.TorqueRobot, A1TorqueCfg, A1TorqueGravityCfgPPO),
    ("a1_torque_curriculum", torque_curriculum.TorqueCurriculumRobot, A1TorqueCurriculumCfg, A1TorqueCurriculumCfgPPO),
    ("a1_torque_multihead", multi_head.MultiHeadRobot, A1TorqueMultiHeadCfg, A1MultiHeadCfgPPO),
    ("a1_multihead", multi_head.MultiHeadRobot, A1MultiHeadCfg, A1MultiHeadCfgPPO),
):
    task_registry.register(name, robot, env_cfg(), train_cfg())
