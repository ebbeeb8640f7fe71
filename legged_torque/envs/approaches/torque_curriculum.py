"""Curriculum pre-training: at first the reward is to stand in the nominal pose (paper, III-B and IV-D)."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_torque.envs.approaches.torque import A1TorqueCfg, A1TorqueCfgPPO, TorqueRobot


class TorqueCurriculumRobot(TorqueRobot):
    """Torque control with one more reward term."""

    def _reward_nominal_position(self) -> Tensor:
        """exp(-gamma |q - q_nominal|^2), joint angles [rad]. Shape: (num_envs,)."""
        error = (self.dof_pos - self.default_dof_pos).square().sum(dim=1)
        return torch.exp(-self.cfg.rewards.nominal_position_temperature * error)


class A1TorqueCurriculumCfg(A1TorqueCfg):
    """Settings of ``a1_torque_curriculum``."""

    class rewards(A1TorqueCfg.rewards):
        nominal_position_temperature = 0.5

        class scales(A1TorqueCfg.rewards.scales):
            nominal_position = 1.0

        class curriculum(A1TorqueCfg.rewards.curriculum):
            class nominal_position:
                start = 20.0
                end = 1.0
                t_start = 0
                t_end = 5_000_000

            class tracking_lin_vel(A1TorqueCfg.rewards.curriculum.tracking_lin_vel):
                t_start = 3_000_000
                t_end = 13_000_000

            class tracking_ang_vel(A1TorqueCfg.rewards.curriculum.tracking_ang_vel):
                t_start = 3_000_000
                t_end = 13_000_000


class A1TorqueCurriculumCfgPPO(A1TorqueCfgPPO):
    """Training of ``a1_torque_curriculum``."""

    class runner(A1TorqueCfgPPO.runner):
        experiment_name = "a1_torque_curriculum"
