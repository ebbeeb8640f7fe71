"""PD control (eq. 8), in torch and for the physics kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp
from torch import Tensor

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot


def pd_torques(task: LeggedRobot, actions: Tensor) -> Tensor:
    """tau = Kp (q_nominal + scale a - q) - Kd qd [N m]. Shapes: (num_envs, num_dof)."""
    target = task.default_dof_pos + task.joint_offset + task.action_scale * actions
    return task.p_gains * (target - task.dof_pos) - task.d_gains * task.dof_vel


@wp.struct
class PdControl:
    """What :func:`pd_torque` reads of a task."""

    default_dof_pos: wp.array[float]
    joint_offset: wp.array2d[float]
    action_scale: wp.array2d[float]
    p_gains: wp.array2d[float]
    d_gains: wp.array2d[float]


@wp.func
def of_joint(scales: wp.array2d[float], world: int, joint: int) -> float:
    """Return a joint's scale; a single column is for all joints, as where torch broadcasts."""
    return scales[world, wp.min(joint, scales.shape[1] - 1)]  # type: ignore[attr-defined]


@wp.func
def pd_torque(task: PdControl, actions: wp.array[float], world: int, joint: int, pos: float, vel: float) -> float:
    """Return what :func:`pd_torques` does, of one joint."""
    target = task.default_dof_pos[joint] + task.joint_offset[world, joint]
    target += of_joint(task.action_scale, world, joint) * actions[joint]
    return task.p_gains[world, joint] * (target - pos) - task.d_gains[world, joint] * vel
