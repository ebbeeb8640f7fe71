"""The task class: imported when the task is built, so that --help and mistakes are answered at once."""

import torch

from legged_torque.envs import TorqueRobot


class QuietRobot(TorqueRobot):
    """Torque control with one more reward term."""

    def _reward_dof_vel(self) -> torch.Tensor:
        """|qd|^2 [rad^2/s^2]. Shape: (num_envs,)."""
        return self.dof_vel.square().sum(dim=1)
