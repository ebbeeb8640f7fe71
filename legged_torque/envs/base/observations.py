"""What the policy and the critic see."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor


class Observations:
    """Observations of :class:`~legged_torque.envs.base.legged_robot.LeggedRobot`, of which this is a part."""

    def compute_observations(self) -> None:
        """Compute what a real robot can measure for the policy, and what only a simulator knows for the critic."""
        scales = self.cfg.normalization.obs_scales
        policy = torch.cat(
            [
                self.projected_gravity,
                self.base_ang_vel * scales.ang_vel,
                self.commands * self._command_scales,
                (self.dof_pos - self.default_dof_pos) * scales.dof_pos,
                self.dof_vel * scales.dof_vel,
                self.actions,
            ],
            dim=1,
        )
        critic = torch.cat(
            [
                policy,
                self.base_lin_vel * scales.lin_vel,
                self.base_pos[:, 2:],
                self.feet_contact,
                self.randomization.values,
            ],
            dim=1,
        )
        if self.cfg.noise.add_noise:
            policy = torch.addcmul(policy, self._noise_scale_vec, self._uniform(policy, [-1.0, 1.0]))
        clip = self.cfg.normalization.clip_observations
        self.obs_buf["policy"].copy_(self._with_history(policy.clamp(-clip, clip)))
        torch.clamp(critic, -clip, clip, out=self.obs_buf["critic"])

    def _with_history(self, policy: Tensor) -> Tensor:
        """Return the policy's observations followed by those of the steps before; an episode starts with copies."""
        length = self.cfg.env.history_length
        if length == 1:
            return policy
        before = self.obs_buf["policy"][:, : -policy.shape[1]]
        copies = policy.repeat(1, length - 1)
        return torch.cat([policy, torch.where(self.reset_buf.unsqueeze(1), copies, before)], dim=1)

    def _init_observations(self) -> None:
        """Allocate the observations and their scales."""
        n, scales = self.num_envs, self.cfg.normalization.obs_scales
        now = 9 + 2 * self.num_dof + self.num_actions
        policy = now * self.cfg.env.history_length
        critic = now + 4 + len(self.feet_indices) + self.randomization.values.shape[1]
        self.obs_buf = TensorDict(
            {name: torch.zeros(n, size, device=self.device) for name, size in (("policy", policy), ("critic", critic))},
            batch_size=[n],
            device=self.device,
        )
        self._command_scales = self._tensor([scales.lin_vel, scales.lin_vel, scales.ang_vel])
        self._noise_scale_vec = self._tensor(self._noise_scales())

    def _noise_scales(self) -> list[float]:
        """Return the largest errors of the policy's observations, in their order and scaled as they are."""
        noise, scales = self.cfg.noise.noise_scales, self.cfg.normalization.obs_scales
        gravity, ang_vel, commands = [noise.gravity] * 3, [noise.ang_vel * scales.ang_vel] * 3, [0.0] * 3
        dof_pos = [noise.dof_pos * scales.dof_pos] * self.num_dof
        dof_vel = [noise.dof_vel * scales.dof_vel] * self.num_dof
        return gravity + ang_vel + commands + dof_pos + dof_vel + [0.0] * self.num_actions
