"""Curriculum pre-training: at first the reward is to stand in the nominal pose (paper, III-B and IV-D)."""

import torch
from torch import Tensor

from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.envs.approaches.torque_curriculum_config import TorqueCurriculumCfg as TorqueCurriculumCfg


class TorqueCurriculumRobot(TorqueRobot):
    """Torque control with one more reward term."""

    cfg: TorqueCurriculumCfg

    def _reward_nominal_position(self) -> Tensor:
        """exp(-gamma |q - q_nominal|^2), joint angles [rad]. Shape: (num_envs,)."""
        error = (self.dof_pos - self.default_dof_pos).square().sum(dim=1)
        return torch.exp(-self.cfg.rewards.nominal_position_temperature * error)
