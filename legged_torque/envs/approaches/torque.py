"""Default torque control: the policy's actions are joint torques (paper, section III and Figure 1)."""

from __future__ import annotations

from torch import Tensor

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO


class TorqueRobot(LeggedRobot):
    """A robot whose actions are torques."""

    def _compute_torques(self, actions: Tensor) -> Tensor:
        """tau = torque_scale a [N m]. Shapes: (num_envs, num_dof)."""
        return self.torque_scale * actions


class A1TorqueCfg(A1Cfg):
    """Settings of ``a1_torque``: those of the A1."""


class A1TorqueCfgPPO(A1CfgPPO):
    """Training of ``a1_torque``."""

    class runner(A1CfgPPO.runner):
        experiment_name = "a1_torque"

    class algorithm(A1CfgPPO.algorithm):
        max_learning_rate = 2e-3  # as long as nothing is rewarded, it rises until the critic diverges
