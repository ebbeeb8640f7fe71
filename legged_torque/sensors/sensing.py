"""What the robot's own sensors, joint encoders and the trunk's IMU, have told the policy."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_torque.envs.base.state import RobotState
from legged_torque.motors.config import LatencyCfg
from legged_torque.sim.packets import PacketQueue
from legged_torque.utils.math import quat_rotate_inverse


class Sensing:
    """Measurements of every physics step, which reach the policy late.

    They are made at the end of a physics step: a push after it is seen in the next one. Names, shapes, units and frames
    are those of :class:`~legged_torque.envs.base.state.RobotState`.

    Attributes:
        projected_gravity, base_ang_vel, dof_pos, dof_vel: What has arrived.
        queue: The measurements on their way: trunk orientation, dof_pos, base_ang_vel and dof_vel.
    """

    def __init__(self, cfg: LatencyCfg, state: RobotState, dt: float, decimation: int) -> None:
        """Allocate room for the longest delay; a UserError if it is not a whole number of physics steps."""
        self._state, num_dof = state, state.dof_pos.shape[1]
        self._sizes, self._measured = (4, num_dof, 3, num_dof), 0
        times, jitter, unit_steps = cfg.counted("sensing.delay", dt, decimation)
        self.queue = PacketQueue(self._packet(), 1, times, unit_steps, jitter, cfg.loss)
        self.projected_gravity = torch.zeros_like(state.projected_gravity)
        self.base_ang_vel = torch.zeros_like(state.base_ang_vel)
        self.dof_pos, self.dof_vel = torch.zeros_like(state.dof_pos), torch.zeros_like(state.dof_vel)
        self._gravity = torch.tensor([[0.0, 0.0, -1.0]], device=state.device)

    def begin(self) -> None:
        """Begin a control step: draw what happens to its measurements."""
        self._measured = 0
        self.queue.draw()

    def measure(self) -> None:
        """Measure at the end of a physics step."""
        self.queue.send(self._packet(), self._measured)
        self._measured += 1

    def update(self, is_new: Tensor) -> None:
        """Look at the end of a control step.

        Where an episode has just started, as ``is_new`` says, the present has arrived. Shape: (num_envs,), bool.
        """
        self.queue.restart(is_new, self._packet())
        self.look()

    def look(self) -> None:
        """Write what has arrived."""
        quat, dof_pos, base_ang_vel, dof_vel = self.queue.received().split(self._sizes, dim=1)
        self.projected_gravity.copy_(quat_rotate_inverse(quat, self._gravity))
        self.base_ang_vel.copy_(base_ang_vel)
        self.dof_pos.copy_(dof_pos)
        self.dof_vel.copy_(dof_vel)

    def _packet(self) -> Tensor:
        """Return a measurement of this moment. Shape: (num_envs, 7 + 2 num_dof)."""
        return torch.cat([self._state.qpos[:, 3:], self._state.qvel[:, 3:]], dim=1)
