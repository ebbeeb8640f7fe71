"""Default torque control: the policy's actions are joint torques (paper, section III and Figure 1)."""

from torch import Tensor

from legged_torque.envs.approaches.torque_config import TorqueCfg as TorqueCfg
from legged_torque.envs.approaches.torque_config import TorqueCfgPPO as TorqueCfgPPO
from legged_torque.envs.base.actions import ActionTerm, torque
from legged_torque.envs.base.legged_robot import LeggedRobot


class TorqueRobot(LeggedRobot):
    """A robot whose actions are torques, or torques and more."""

    def action_terms(self) -> list[ActionTerm]:
        """Return one torque per joint: tau = torque_scale a [N m]."""
        return [torque(self.control)]

    def actions_for(self, torques: Tensor) -> Tensor:
        """Return the actions that lead to torques [N m] in the present state. Shape: (num_envs, num_actions)."""
        return torques / self.control.torque_scale
