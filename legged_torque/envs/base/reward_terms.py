"""The reward terms of all tasks: one value per world without its weight, shape (num_envs,)."""

import torch
from torch import Tensor

from legged_torque.envs.base.actions import ControlParameters
from legged_torque.envs.base.asset import Asset
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.state import RobotState
from legged_torque.envs.base.symmetry import RobotSymmetry
from legged_torque.sim.model import indices_matching
from legged_torque.utils.mjcf import joint_limits

STANDING_COMMAND = 0.1  # norm of a command [m/s, rad/s] up to which robots may stand
STUMBLING = 5.0
"""A foot stumbles if the force on it is this many times as large horizontally as vertically, as in legged_gym."""


class RewardTerms:
    """A term is a method ``_reward_<term>`` of the task; ``rewards.scales.<term>`` is its weight."""

    cfg: LeggedRobotCfg
    state: RobotState
    control: ControlParameters
    symmetry: RobotSymmetry

    def _init_reward_buffers(self, asset: Asset, device: str) -> None:
        """Allocate what the terms compare with: soft limits of the joints [rad], and parts by number."""
        ranges = torch.tensor(joint_limits(asset.mj_model)[1:], dtype=torch.float32, device=device)
        middle = ranges.mean(dim=1, keepdim=True).nan_to_num()  # of joints without a range
        self.dof_pos_limits = middle + self.cfg.rewards.soft_dof_pos_limit * (ranges - middle)
        self.penalized_contact_indices = torch.tensor(asset.penalized, dtype=torch.long, device=device)
        held = indices_matching(asset.dof_names, self.cfg.rewards.held_joints, "joint in rewards.held_joints")
        self.held_joints = torch.zeros(len(asset.dof_names), device=device)
        self.held_joints[held] = 1.0

    def _reward_tracking_lin_vel(self) -> Tensor:
        """exp(-gamma |v*_xy - v_xy|^2), velocities in the trunk's frame [m/s]."""
        error = (self.state.commands[:, :2] - self.state.base_lin_vel[:, :2]).square().sum(dim=1)
        return torch.exp(-self.cfg.rewards.tracking_temperature * error)

    def _reward_tracking_ang_vel(self) -> Tensor:
        """exp(-gamma (w*_z - w_z)^2), trunk frame [rad/s]."""
        error = (self.state.commands[:, 2] - self.state.base_ang_vel[:, 2]).square()
        return torch.exp(-self.cfg.rewards.tracking_temperature * error)

    def _reward_lin_vel_z(self) -> Tensor:
        """v_z^2, trunk frame [m^2/s^2]."""
        return self.state.base_lin_vel[:, 2].square()

    def _reward_ang_vel_xy(self) -> Tensor:
        """|w_xy|^2, trunk frame [rad^2/s^2]."""
        return self.state.base_ang_vel[:, :2].square().sum(dim=1)

    def _reward_orientation(self) -> Tensor:
        """|g_xy|^2 of the unit gravity vector in the trunk's frame."""
        return self.state.projected_gravity[:, :2].square().sum(dim=1)

    def _reward_dof_pos_limits(self) -> Tensor:
        """Sum over joints of how far they are beyond their soft limits [rad]."""
        below = (self.dof_pos_limits[:, 0] - self.state.dof_pos).clamp(min=0.0)
        above = (self.state.dof_pos - self.dof_pos_limits[:, 1]).clamp(min=0.0)
        return (below + above).sum(dim=1)

    def _reward_dof_acc(self) -> Tensor:
        """|(qd_last - qd) / Delta t|^2, from control step to control step [rad^2/s^4]."""
        return ((self.state.last_dof_vel - self.state.dof_vel) / self.state.dt).square().sum(dim=1)

    def _reward_torques(self) -> Tensor:
        """|tau|^2 of the applied torques [N^2 m^2]."""
        return self.state.torques.square().sum(dim=1)

    def _reward_action_rate(self) -> Tensor:
        """|a_last - a|^2."""
        return (self.state.last_actions - self.state.actions).square().sum(dim=1)

    def _reward_collision(self) -> Tensor:
        """Number of geoms of ``asset.penalize_contacts_on`` that touch something."""
        return self.state.contacts[:, self.penalized_contact_indices].sum(dim=1)

    def _reward_base_height(self) -> Tensor:
        """(z - z_nominal - z_terrain)^2 of the trunk [m^2]."""
        return (self.state.base_height - self.cfg.rewards.base_height_target).square()

    def _reward_feet_air_time(self) -> Tensor:
        """Sum over the feet on the ground of (t_swing - target), t_swing being the swing that has just ended.

        Table III has a weight of -0.1 and a caption by which positive weights encourage; the authors' environment has
        +0.1, which rewards long swings and is used here. A foot that stays on the ground has t_swing = 0.
        """
        return ((self.state.feet_air_time - self.cfg.rewards.feet_air_time_target) * self.state.feet_contact).sum(dim=1)

    def _reward_symmetry(self) -> Tensor:
        """1 for each pair of left and right feet, front or rear, of which both are in the air."""
        in_air = 1.0 - self.state.feet_contact
        pairs = [in_air[:, right] * in_air[:, left] for right, left in self.symmetry.foot_pairs]
        return sum(pairs[1:], pairs[0])

    def _reward_single_stance(self) -> Tensor:
        """Share of feet_air_time_target for which a foot has swung while its counterpart stands; then 0.

        Summed over pairs of feet, and only under a command to move. Who hops or stands on one leg gets nothing.
        """
        target = self.cfg.rewards.feet_air_time_target
        swing = torch.where(self.state.feet_air_time < target, self.state.feet_air_time / target, 0.0)
        swing = swing * (1.0 - self.state.feet_contact)
        stance = self.state.feet_contact
        pairs = [swing[:, r] * stance[:, left] + swing[:, left] * stance[:, r] for r, left in self.symmetry.foot_pairs]
        return sum(pairs[1:], pairs[0]) * (self.state.commands.norm(dim=1) > STANDING_COMMAND)

    def _reward_dof_deviation(self) -> Tensor:
        """Sum of |q - q_nominal| over ``rewards.held_joints`` [rad]."""
        return ((self.state.dof_pos - self.control.default_dof_pos) * self.held_joints).abs().sum(dim=1)

    def _reward_alive(self) -> Tensor:
        """1 at every step."""
        return torch.ones_like(self.state.base_lin_vel[:, 0])

    def _reward_stumble(self) -> Tensor:
        """1 if a foot is pushed against a wall: see :data:`STUMBLING`."""
        force = self.state.contact_force[:, self.state.feet_indices]
        return (force[:, :, :2].norm(dim=2) > STUMBLING * force[:, :, 2].abs()).any(dim=1).float()
