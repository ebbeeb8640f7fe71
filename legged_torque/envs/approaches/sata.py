"""SATA: torques by muscles that are activated, tire and grow (Li et al., RSS 2025; marmotlab/SATA, go2_torque.py).

The link ``muscle`` has the formulas. As there, lost measurements and actions leave the ones before; there, lost actions
leave activations, too. Here the policy does not observe the trunk's velocity and torques. An export acts at 200 Hz, as
grown robots do, with the torques of its checkpoint's age.
"""

from typing import Any

import torch
from torch import Tensor

from legged_torque.envs.approaches.sata_config import SataCfg as SataCfg
from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.envs.base.observations import ObservationTerm
from legged_torque.motors.models import MuscleModel
from legged_torque.utils.errors import UserError


class SataRobot(TorqueRobot):
    """Torque control by muscles, whose fatigue is observed and penalized.

    Attributes:
        growth: The way to a grown robot, from 0 to 1. Shape: (1,).
    """

    cfg: SataCfg

    def _init_state(self) -> None:
        """Find the muscles, and begin to grow; a UserError without muscles, or with a growth of their own."""
        super()._init_state()
        muscles = [link for link in self.motors.links.values() if isinstance(link, MuscleModel)]
        if len(muscles) != 1:
            raise UserError(f"motors.chain must have one muscle, not {', '.join(self.motors.links)}")
        own: Any = muscles[0].cfg
        if own.growth != 1.0 or "growth" in own.draws:
            path = f"{muscles[0].joints.section}.growth"
            raise UserError(f"{path} and its draws have no effect here, where control.growth says how robots grow")
        self.muscles = muscles[0].values
        self.growth = torch.zeros(1, device=self.device)
        self.update_curriculum()

    def update_curriculum(self) -> None:
        """Let the muscles grow."""
        growth = self.cfg.control.growth
        self.growth.copy_(torch.exp(-torch.exp(-growth.k * (self.total_steps - growth.t_mid))))
        self.muscles.growth.copy_(growth.torque + (1.0 - growth.torque) * self.growth)

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return the growth too."""
        return super().curriculum_values() | {"growth": self.growth[0]}

    def run_physics(self) -> None:
        """Hold actions where new ones are not due yet; an episode starts with new ones."""
        first = self.cfg.control.growth.rate
        sent = self.episode_length_buf * (first + (1.0 - first) * self.growth)  # actions since the start
        before = (self.episode_length_buf - 1) * (first + (1.0 - first) * self.growth)
        is_due = (sent.floor() > before.floor()).unsqueeze(1)
        self.actions.copy_(torch.where(is_due, self.actions, self.last_actions))
        super().run_physics()

    def observation_terms(self) -> list[ObservationTerm]:
        """Return the usual ones, and the fatigue."""
        joints, meaning = self.symmetry.joints, "decaying sum of |torque| dt"
        mirror, fatigue = joints and joints.unsigned(), self.muscles.fatigue
        seen = ObservationTerm("fatigue", lambda: fatigue, mirror, unit="N m s", frame="joint", meaning=meaning)
        return [*super().observation_terms(), seen]

    def _reward_fatigue(self) -> Tensor:
        """Sum of fatigue times wanted torque, over joints. Shape: (num_envs,)."""
        return (self.muscles.fatigue * (self.control.torque_scale * self.actions).abs()).sum(dim=1)
