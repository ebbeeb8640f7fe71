"""What the robot's own sensors, joint encoders and the trunk's IMU, have told the policy."""

import torch
from torch import Tensor

from legged_torque.envs.base.state import RobotState
from legged_torque.motors.chain import MotorChain
from legged_torque.motors.config import LatencyCfg
from legged_torque.sim.packets import PacketQueue
from legged_torque.utils.math import quat_rotate_inverse


class Sensing:
    """Measurements of every physics step, which reach the policy late.

    They are made at the end of a physics step: a push after it is seen in the next one. Names, shapes, units and frames
    are those of :class:`~legged_torque.envs.base.state.RobotState`.

    Attributes:
        base_ang_vel, dof_pos, dof_vel: What has arrived.
        queue: The measurements on their way: trunk orientation, dof_pos, base_ang_vel and dof_vel.
    """

    def __init__(self, cfg: LatencyCfg, state: RobotState, motors: MotorChain, dt: float, decimation: int) -> None:
        """Allocate room for the longest delay; a UserError if it is not a whole number of physics steps."""
        self._motors, num_dof = motors, state.dof_pos.shape[1]
        self._orientation_and_joints, self._velocities = state.qpos[:, 3:], state.qvel[:, 3:]
        self._measured = 0
        times, jitter, unit_steps = cfg.counted("sensing.delay", dt, decimation)
        self.queue = PacketQueue(self._packet(), 1, times, unit_steps, jitter, cfg.loss)
        is_regular = not jitter and not cfg.loss
        self._first = max(decimation - 1 - self.queue.depth, 0) if is_regular else 0  # that can still be the newest
        self._arrived = torch.zeros_like(self._packet())
        parts = self._arrived.split((4, num_dof, 3, num_dof), dim=1)
        self._quat, self.dof_pos, self.base_ang_vel, self.dof_vel = parts
        self._gravity = torch.tensor([[0.0, 0.0, -1.0]], device=state.device)

    def begin_step(self) -> None:
        """Begin a control step: draw what happens to its measurements."""
        self._measured = 0
        self.queue.draw()

    def measure(self) -> None:
        """Measure at the end of a physics step, unless no policy will see it."""
        if self._measured >= self._first:
            self.queue.send(self._orientation_and_joints, self._velocities, self._measured)
        self._measured += 1

    def begin_episodes(self, is_new: Tensor) -> None:
        """Let the present have arrived where an episode has just started, as ``is_new`` says.

        Shape: (num_envs,), bool.
        """
        self.queue.restart(is_new, self._packet())

    def look(self) -> None:
        """Write what has arrived, as the joint encoders give it."""
        self._arrived.copy_(self.queue.received(0) if self.queue.is_needed else self._packet())
        if self._motors.encoder:
            pos, vel = self._motors.measured(self.dof_pos, self.dof_vel)
            self.dof_pos.copy_(pos)
            self.dof_vel.copy_(vel)

    @property
    def projected_gravity(self) -> Tensor:
        """That of the orientation that has arrived."""
        return quat_rotate_inverse(self._quat, self._gravity)

    def _packet(self) -> Tensor:
        """Return a measurement of this moment, before the encoders. Shape: (num_envs, 7 + 2 num_dof)."""
        return torch.cat([self._orientation_and_joints, self._velocities], dim=1)
