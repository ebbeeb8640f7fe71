"""Multi-head control: position and torque actions, mixed with weights that change in training (paper, III-C, IV-E)."""

import dataclasses

import torch
from torch import Tensor

from legged_torque.envs.approaches.multi_head_config import CurriculumMultiHeadCfg as CurriculumMultiHeadCfg
from legged_torque.envs.approaches.multi_head_config import MultiHeadCfgPPO as MultiHeadCfgPPO
from legged_torque.envs.approaches.multi_head_config import MultiHeadTwoRatesCfg as MultiHeadTwoRatesCfg
from legged_torque.envs.approaches.multi_head_config import TorqueMultiHeadCfg as TorqueMultiHeadCfg
from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.envs.approaches.torque_curriculum import TorqueCurriculumRobot
from legged_torque.envs.base.actions import ActionTerm, position_residual, torque
from legged_torque.envs.base.curriculum import LinearCurriculum
from legged_torque.envs.base.observations import ObservationTerm
from legged_torque.utils.mirroring import SCALAR


class MultiHeadRobot(TorqueRobot):
    """A robot with two actions per joint: a position residual, then a torque.

    Attributes:
        mixing: theta_pd and theta_torque of eq. 7. Shape: (2,).
    """

    cfg: TorqueMultiHeadCfg

    def _init_buffers(self) -> None:
        """Allocate the mixing weights as well."""
        super()._init_buffers()
        settings = self.cfg.control.mixing
        self._mixing_curriculum = LinearCurriculum([settings.pd, settings.torque], self.device)
        self.mixing = torch.zeros(2, device=self.device)
        self.update_curriculum()

    def action_terms(self) -> list[ActionTerm]:
        """Return a position residual and a torque per joint, mixed by their weights.

        tau = theta_pd tau_pd(a[:n]) + theta_torque torque_scale a[n:] (eq. 7) [N m].
        """
        theta_pd, theta_torque = self.mixing
        return [position_residual(self.control, theta_pd), torque(self.control, theta_torque)]

    def update_curriculum(self) -> None:
        """Set the mixing weights by eq. 1, at the last multiple of the update interval."""
        interval = self.cfg.control.mixing.update_interval
        self.mixing.copy_(self._mixing_curriculum(self.total_steps // interval * interval))

    def actions_for(self, torques: Tensor) -> Tensor:
        """Return the actions that lead to torques [N m]: all of them by the torque part. Shape: (num_envs, 2 num_dof).

        PD targets are where the PD part is 0, so that whoever has learned these actions gives the same torques at every
        weight of the PD part, and loses nothing while it fades.
        """
        control, (positions, _) = self.control, self.control_law.terms
        rest = positions.torques(torch.zeros_like(torques), self.dof_pos, self.dof_vel)
        rest = rest / (control.p_gains * control.action_scale)
        return torch.cat([-rest, torques / (self.mixing[1] * control.torque_scale)], dim=1)

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return the mixing weights too."""
        return super().curriculum_values() | {"mixing_pd": self.mixing[0], "mixing_torque": self.mixing[1]}


class CurriculumMultiHeadRobot(MultiHeadRobot, TorqueCurriculumRobot):
    """Actions of multi-head control, with the reward for the nominal pose."""

    cfg: CurriculumMultiHeadCfg


class MultiHeadTwoRatesRobot(MultiHeadRobot):
    """Multi-head control whose torques act at every control step, and whose position actions are held for several.

    Actions are held before anything else sees them: ``actions``, delays, ``last_action`` and the reward for their rate
    know the ones that act. How long they will be held is observed, else the same state could go on in several ways.
    """

    cfg: MultiHeadTwoRatesCfg

    def action_terms(self) -> list[ActionTerm]:
        """Return the terms of multi-head control, of which the positions are held."""
        positions, torques = super().action_terms()
        return [dataclasses.replace(positions, interval=self.cfg.control.position_interval), torques]

    def run_physics(self) -> None:
        """Hold position actions where new ones are not due; an episode starts with new ones."""
        positions, held = (actions[:, : self.num_dof] for actions in (self.actions, self.last_actions))
        positions.copy_(torch.where(self.position_phase() == 0.0, positions, held))
        super().run_physics()

    def position_phase(self) -> Tensor:
        """Return the share of the interval for which position actions have been held; 0: new ones are due.

        Shape: (num_envs, 1).
        """
        interval = self.cfg.control.position_interval
        return (self.episode_length_buf % interval / interval).unsqueeze(1)

    def observation_terms(self) -> list[ObservationTerm]:
        """Return the usual ones, and how long the position actions have been held."""
        meaning = "share of the interval for which position actions have been held; 0: new ones are due"
        phase = ObservationTerm("position_phase", self.position_phase, SCALAR, meaning=meaning)
        return [*super().observation_terms(), phase]
