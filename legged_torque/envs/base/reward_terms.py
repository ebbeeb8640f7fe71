"""The reward terms of all tasks: one value per world without its weight, shape (num_envs,)."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.symmetry import RobotSymmetry
from legged_torque.sim.engine import Engine

STANDING_COMMAND = 0.1  # norm of a command [m/s, rad/s] up to which robots may stand
STUMBLING = 5.0
"""A foot stumbles if the force on it is this many times as large horizontally as vertically, as in legged_gym."""


class RewardTerms(ABC):
    """A term is a method ``_reward_<term>`` of the task; ``rewards.scales.<term>`` is its weight.

    What terms read are attributes of :class:`~legged_torque.envs.base.legged_robot.LeggedRobot`.
    """

    cfg: LeggedRobotCfg
    sim: Engine
    symmetry: RobotSymmetry
    dt: float
    commands: Tensor
    actions: Tensor
    last_actions: Tensor
    torques: Tensor
    base_lin_vel: Tensor
    base_ang_vel: Tensor
    projected_gravity: Tensor
    dof_pos: Tensor
    default_dof_pos: Tensor
    held_joints: Tensor
    dof_vel: Tensor
    last_dof_vel: Tensor
    dof_pos_limits: Tensor
    contacts: Tensor
    penalized_contact_indices: Tensor
    feet_indices: Tensor
    feet_contact: Tensor
    feet_air_time: Tensor

    @property
    @abstractmethod
    def base_height(self) -> Tensor:
        """Height of the trunk's origin above the ground under it [m]. Shape: (num_envs,)."""

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
        """(z - z_nominal - z_terrain)^2 of the trunk [m^2]."""
        return (self.base_height - self.cfg.rewards.base_height_target).square()

    def _reward_feet_air_time(self) -> Tensor:
        """Sum over the feet on the ground of (t_swing - target), t_swing being the swing that has just ended.

        Table III has a weight of -0.1 and a caption by which positive weights encourage; the authors' environment has
        +0.1, which rewards long swings and is used here. A foot that stays on the ground has t_swing = 0.
        """
        return ((self.feet_air_time - self.cfg.rewards.feet_air_time_target) * self.feet_contact).sum(dim=1)

    def _reward_symmetry(self) -> Tensor:
        """1 for each pair of left and right feet, front or rear, of which both are in the air."""
        in_air = 1.0 - self.feet_contact
        pairs = [in_air[:, right] * in_air[:, left] for right, left in self.symmetry.foot_pairs]
        return sum(pairs[1:], pairs[0])

    def _reward_single_stance(self) -> Tensor:
        """Share of feet_air_time_target for which a foot has swung while its counterpart stands; then 0.

        Summed over pairs of feet, and only under a command to move. Who hops or stands on one leg gets nothing.
        """
        target = self.cfg.rewards.feet_air_time_target
        swing = torch.where(self.feet_air_time < target, self.feet_air_time / target, 0.0)
        swing = swing * (1.0 - self.feet_contact)
        stance = self.feet_contact
        pairs = [swing[:, r] * stance[:, left] + swing[:, left] * stance[:, r] for r, left in self.symmetry.foot_pairs]
        return sum(pairs[1:], pairs[0]) * (self.commands.norm(dim=1) > STANDING_COMMAND)

    def _reward_dof_deviation(self) -> Tensor:
        """Sum of |q - q_nominal| over ``rewards.held_joints`` [rad]."""
        return ((self.dof_pos - self.default_dof_pos) * self.held_joints).abs().sum(dim=1)

    def _reward_alive(self) -> Tensor:
        """1 at every step."""
        return torch.ones_like(self.base_lin_vel[:, 0])

    def _reward_stumble(self) -> Tensor:
        """1 if a foot is pushed against a wall: see :data:`STUMBLING`."""
        force = self.sim.contact_force[:, self.feet_indices]
        return (force[:, :, :2].norm(dim=2) > STUMBLING * force[:, :, 2].abs()).any(dim=1).float()
