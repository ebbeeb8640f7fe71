"""Default torque control: the policy's actions are joint torques (paper, section III and Figure 1)."""

from __future__ import annotations

import warp as wp
from torch import Tensor

from legged_torque.envs.approaches.torque_config import TorqueCfg as TorqueCfg
from legged_torque.envs.approaches.torque_config import TorqueCfgPPO as TorqueCfgPPO
from legged_torque.envs.base.actions import ActionTerm, torque
from legged_torque.envs.base.control_laws import of_joint
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.motors.drive import in_kernel


@wp.struct
class TorqueControl:
    """What :func:`scaled_torque` reads of a task."""

    torque_scale: wp.array2d[float]


@wp.func
def scaled_torque(
    task: TorqueControl, actions: wp.array[float], world: int, joint: int, pos: float, vel: float
) -> float:
    """Return the torque of one joint."""
    return of_joint(task.torque_scale, world, joint) * actions[joint]


class TorqueRobot(LeggedRobot):
    """A robot whose actions are torques, or torques and more."""

    def action_terms(self) -> list[ActionTerm]:
        """Return one torque per joint."""
        return [torque(self.torque_scale)]

    @in_kernel(scaled_torque)
    def _compute_torques(self, actions: Tensor) -> Tensor:
        """tau = torque_scale a [N m]. Shapes: (num_envs, num_dof)."""
        return self.torque_scale * actions

    def actions_for(self, torques: Tensor) -> Tensor:
        """Return the actions that lead to torques [N m] in the present state. Shape: (num_envs, num_actions)."""
        return torques / self.torque_scale
