"""The reward terms of Table III. A task adds a term by adding a method ``_reward_<term>`` and a scale for it."""

from __future__ import annotations

import torch
from torch import Tensor


class RewardTerms:
    """Reward terms of :class:`~legged_torque.envs.base.legged_robot.LeggedRobot`, of which this is a part.

    Each method returns one value per world, shape (num_envs,), without its weight.
    """

    def _reward_tracking_lin_vel(self) -> Tensor:
        """exp(-gamma |v*_xy - v_xy|^2), velocities in the trunk's frame [m/s]."""
        error = (self.commands[:, :2] - self.base_lin_vel[:, :2]).square().sum(dim=1)
        return torch.exp(-self.cfg.rewards.tracking_temperature * error)

    def _reward_tracking_ang_vel(self) -> Tensor:
        """exp(-gamma (w*_z - w_z)^2), trunk frame [rad/s]."""
        error = (self.commands[:, 2] - self.base_ang_vel[:, 2]).square()
        return torch.exp(-self.cfg.rewards.tracking_temperature * error)

    def _reward_lin_vel_z(self) -> Tensor:
        """v_z^2, trunk frame [m^2/s^2]."""
        return self.base_lin_vel[:, 2].square()

    def _reward_ang_vel_xy(self) -> Tensor:
        """|w_xy|^2, trunk frame [rad^2/s^2]."""
        return self.base_ang_vel[:, :2].square().sum(dim=1)

    def _reward_orientation(self) -> Tensor:
        """|g_xy|^2 of the unit gravity vector in the trunk's frame."""
        return self.projected_gravity[:, :2].square().sum(dim=1)

    def _reward_dof_pos_limits(self) -> Tensor:
        """Sum over joints of how far they are beyond their soft limits [rad]."""
        below = (self.dof_pos_limits[:, 0] - self.dof_pos).clamp(min=0.0)
        above = (self.dof_pos - self.dof_pos_limits[:, 1]).clamp(min=0.0)
        return (below + above).sum(dim=1)

    def _reward_dof_acc(self) -> Tensor:
        """|(qd_last - qd) / Delta t|^2, from control step to control step [rad^2/s^4]."""
        return ((self.last_dof_vel - self.dof_vel) / self.dt).square().sum(dim=1)

    def _reward_torques(self) -> Tensor:
        """|tau|^2 of the applied torques [N^2 m^2]."""
        return self.torques.square().sum(dim=1)

    def _reward_action_rate(self) -> Tensor:
        """|a_last - a|^2."""
        return (self.last_actions - self.actions).square().sum(dim=1)

    def _reward_collision(self) -> Tensor:
        """Number of calves, thighs and trunks that touch the ground."""
        return self.contacts[:, self.penalized_contact_indices].sum(dim=1)

    def _reward_base_height(self) -> Tensor:
        """(z - z_nominal - z_terrain)^2 of the trunk [m^2]; the terrain is a plane at 0."""
        return (self.base_pos[:, 2] - self.cfg.rewards.base_height_target).square()

    def _reward_feet_air_time(self) -> Tensor:
        """Sum over the feet on the ground of (t_swing - 0.5 s), t_swing being the swing that has just ended.

        Table III has a weight of -0.1 and a caption by which positive weights encourage; the authors' environment has
        +0.1, which rewards long swings and is used here. A foot that stays on the ground has t_swing = 0.
        """
        return ((self.feet_air_time - 0.5) * self.feet_contact).sum(dim=1)

    def _reward_symmetry(self) -> Tensor:
        """1 for each pair of left and right feet, front or rear, of which both are in the air."""
        in_air = 1.0 - self.feet_contact
        return in_air[:, 0] * in_air[:, 1] + in_air[:, 2] * in_air[:, 3]
