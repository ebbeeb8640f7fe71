"""What happens at random in a task: resets, commands, changes of parameters, pushes, errors of sensors."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_torque.utils.math import quat_from_euler


class RandomEvents:
    """Random events of :class:`~legged_torque.envs.base.legged_robot.LeggedRobot`, of which this is a part.

    Worlds are chosen by mask, and numbers are drawn for all worlds and kept where they are due, since a step replays
    as a CUDA graph.
    """

    def _reset_worlds(self) -> None:
        """Start a new episode in the worlds of ``reset_buf``; elsewhere draw anew what is due."""
        mask = self.reset_buf
        self.sim.reset(mask)
        self._reset_dofs(mask)
        self._reset_root_states(mask)
        for buffer in (self.actions, self.feet_air_time):
            buffer.masked_fill_(mask.unsqueeze(1), 0.0)
        self._episode_length_buf.masked_fill_(mask, 0)
        self.episode_sums.masked_fill_(mask, 0.0)
        self.episode_return.masked_fill_(mask, 0.0)
        rand = self.cfg.domain_rand
        self._resample_commands(mask | self._due(self.cfg.commands.resampling_probability))
        if rand.randomize_parameters:
            self._randomize_parameters(mask | self._due(rand.resampling_probability))
        if rand.push_robots:
            self._push_robots(self._due(rand.push_probability))
        self._update_state()

    def _due(self, probability: float) -> Tensor:
        """Choose worlds at random. Shape: (num_envs,), bool."""
        return torch.rand(self.num_envs, device=self.device) < probability

    def _uniform(self, like: Tensor, limits: list[float]) -> Tensor:
        """Return uniform random numbers in the shape of a tensor."""
        return torch.empty_like(like).uniform_(*limits)

    def _reset_dofs(self, mask: Tensor) -> None:
        """Draw joint positions around q_nominal and joint velocities for the worlds in ``mask``."""
        rand, column = self.cfg.domain_rand, mask.unsqueeze(1)
        angles = self.default_dof_pos * self._uniform(self.dof_pos, rand.init_dof_pos_scale)
        angles = angles.clamp(self._hard_dof_pos_limits[:, 0], self._hard_dof_pos_limits[:, 1])
        self.dof_pos.copy_(torch.where(column, angles, self.dof_pos))
        self._reset_velocity(self.dof_vel, rand.init_dof_vel, mask)

    def _reset_root_states(self, mask: Tensor) -> None:
        """Draw the trunk's orientation and velocities for the worlds in ``mask``, at the initial position."""
        rand, column = self.cfg.domain_rand, mask.unsqueeze(1)
        angles = [self._uniform(self.rew_buf, limits) for limits in (rand.init_roll, rand.init_pitch, rand.init_yaw)]
        self.base_pos.copy_(torch.where(column, self._init_pos, self.base_pos))
        self.base_quat.copy_(torch.where(column, quat_from_euler(*angles), self.base_quat))
        self._reset_velocity(self.sim.qvel[:, :3], rand.init_lin_vel, mask)
        self._reset_velocity(self.base_ang_vel, rand.init_ang_vel, mask)

    def _reset_velocity(self, velocity: Tensor, limits: list[float], mask: Tensor) -> None:
        """Draw velocities for the worlds in ``mask``; the simulator has just put them at rest."""
        if any(limits):
            velocity.copy_(torch.where(mask.unsqueeze(1), self._uniform(velocity, limits), velocity))

    def _randomize_parameters(self, mask: Tensor) -> None:
        """Draw parameters of robot, ground and controller anew for the worlds in ``mask``."""
        self.randomization.draw(mask)
        self.sim.update_constants(mask)

    def _push_robots(self, mask: Tensor) -> None:
        """Push the worlds in ``mask``: half the time a drawn velocity is set, half the time it is added."""
        velocity = self.sim.qvel[:, :3]
        drawn = self._uniform(velocity, self.cfg.domain_rand.push_velocity)
        added = self._due(0.5).unsqueeze(1)
        velocity.copy_(torch.where(mask.unsqueeze(1), drawn + added * velocity, velocity))

    def _resample_commands(self, mask: Tensor) -> None:
        """Draw new commands for the worlds in ``mask``."""
        drawn = self._command_low + self._command_span * torch.rand_like(self.commands)
        self.commands.copy_(torch.where(mask.unsqueeze(1), drawn, self.commands))
