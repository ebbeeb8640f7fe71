"""The ends of episodes: time-outs, and terms as rewards have them."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.state import RobotState
from legged_torque.utils.buffers import check_tensor
from legged_torque.utils.config import to_dict
from legged_torque.utils.errors import check_names


class Terminations:
    """A term is a method ``_termination_<term>`` of the task, of shape (num_envs,) and bool.

    It is in use if ``terminations.<term>`` is neither 0 nor False; the setting can be its limit.
    """

    cfg: LeggedRobotCfg
    state: RobotState
    num_envs: int
    max_episode_length: int

    def _init_terminations(self, contacts: list[int], device: str) -> None:
        """Collect the terms in use; ``contacts`` are geoms that may not touch. A UserError if a term is unknown."""
        self.termination_contact_indices = torch.tensor(contacts, dtype=torch.long, device=device)
        self.steps_before = torch.zeros(self.num_envs, dtype=torch.long, device=device)  # in evaluations
        known = [name.removeprefix("_termination_") for name in dir(self) if name.startswith("_termination_")]
        self.terminations: dict[str, Callable[[], Tensor]] = {}
        for name, limit in to_dict(self.cfg.terminations).items():
            check_names("termination", [name], known)
            if limit:
                self.terminations[name] = getattr(self, f"_termination_{name}")

    def check_termination(self) -> None:
        """End episodes if a term says so, their state diverged, or their time is over, which alone is a time-out."""
        state, ended = self.state, self.state.diverged
        for name, is_over in self.terminations.items():
            over = is_over()
            check_tensor(f"termination '{name}'", over, ended.shape, ended.device, torch.bool)
            ended = ended | over
        time_out = state.episode_length + self.steps_before >= self.max_episode_length
        state.reset_buf.copy_(ended | time_out)
        state.time_out_buf.copy_(time_out & ~ended)

    def _termination_contact(self) -> Tensor:
        """Whether a geom of ``asset.terminate_after_contacts_on`` touches the ground."""
        return self.state.contacts[:, self.termination_contact_indices].any(dim=1)

    def _termination_tilt(self) -> Tensor:
        """Whether the trunk's vertical is more than ``terminations.tilt`` away from the world's [rad]."""
        return -self.state.projected_gravity[:, 2] < math.cos(self.cfg.terminations.tilt)

    def _termination_base_height(self) -> Tensor:
        """Whether the trunk is lower above the ground than ``terminations.base_height`` [m]."""
        return self.state.base_height < self.cfg.terminations.base_height
