"""Default torque control: the policy's actions are joint torques (paper, section III and Figure 1)."""

from __future__ import annotations

from torch import Tensor

from legged_torque.envs.approaches.torque_config import TorqueCfg as TorqueCfg
from legged_torque.envs.approaches.torque_config import TorqueCfgPPO as TorqueCfgPPO
from legged_torque.envs.base.actions import ActionTerm, torque
from legged_torque.envs.base.legged_robot import LeggedRobot


class TorqueRobot(LeggedRobot):
    """A robot whose actions are torques."""

    def action_terms(self) -> list[ActionTerm]:
        """Return one torque per joint."""
        return [torque(self.torque_scale)]

    def _compute_torques(self, actions: Tensor) -> Tensor:
        """tau = torque_scale a [N m]. Shapes: (num_envs, num_dof)."""
        return self.torque_scale * actions
