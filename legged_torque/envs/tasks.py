"""Every task by name: robot x approach x ground, by listing their settings as bases, the approach first.

Task classes are named, not imported, so that a command line is answered before torch is there.
"""

from __future__ import annotations

from legged_torque.envs.approaches import multi_head_config as multi_head
from legged_torque.envs.approaches import torque_config as torque
from legged_torque.envs.approaches import torque_curriculum_config as torque_curriculum
from legged_torque.envs.approaches import torque_gravity
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


_ROBOT = "legged_torque.envs.base.legged_robot:LeggedRobot"
_TORQUE = "legged_torque.envs.approaches.torque:TorqueRobot"
_CURRICULUM = "legged_torque.envs.approaches.torque_curriculum:TorqueCurriculumRobot"
_MULTI_HEAD = "legged_torque.envs.approaches.multi_head:MultiHeadRobot"

for name, robot, env_cfg, train_cfg in (
    ("a1_position", _ROBOT, A1Cfg, A1CfgPPO),
    ("a1_torque", _TORQUE, A1TorqueCfg, A1TorqueCfgPPO),
    ("a1_torque_gravity", _TORQUE, A1TorqueCfg, A1TorqueGravityCfgPPO),
    ("a1_torque_curriculum", _CURRICULUM, A1TorqueCurriculumCfg, A1TorqueCurriculumCfgPPO),
    ("a1_torque_multihead", _MULTI_HEAD, A1TorqueMultiHeadCfg, A1MultiHeadCfgPPO),
    ("a1_multihead", _MULTI_HEAD, A1MultiHeadCfg, A1MultiHeadCfgPPO),
):
    task_registry.register(name, robot, env_cfg(), train_cfg())
