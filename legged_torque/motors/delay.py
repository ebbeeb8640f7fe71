"""Time that actions take from the policy to the motors."""

from typing import Any

from torch import Tensor

from legged_torque.motors.config import DelayCfg
from legged_torque.motors.motor import Joints, Motor
from legged_torque.sim.packets import PacketQueue, received_packet
from legged_torque.sim.randomization import RandomParameter


class ActionDelay(Motor):
    """Holds actions back; those of each control step are a packet, which may jitter and get lost.

    What the control law adds from joint positions and velocities is not late.

    Attributes:
        queue: The packets on their way.
    """

    acts_on = "actions"
    kernel = received_packet
    cfg: DelayCfg

    def __init__(self, cfg: DelayCfg, joints: Joints) -> None:
        """Allocate room for the longest delay; a UserError if it is not a whole number of physics steps."""
        super().__init__(cfg, joints)
        times, jitter, unit_steps = cfg.counted(joints.section, joints.dt, joints.decimation)
        self.queue = PacketQueue(joints.actions, joints.decimation, times, unit_steps, jitter, cfg.loss)

    def send(self, actions: Tensor) -> None:
        """Send the actions of this control step."""
        self.queue.draw()
        self.queue.send(actions)

    def apply(self, wanted: Tensor, pos: Tensor, vel: Tensor, substep: int) -> Tensor:
        """Return the actions that have reached the motors. Shape: (num_envs, num_actions)."""
        return self.queue.received(substep)

    def kernel_reads(self) -> Any:
        """Return the queue."""
        return self.queue.reads()

    def reset(self, mask: Tensor) -> None:
        """Forget the actions of ended episodes."""
        self.queue.restart(mask, self.joints.actions.new_zeros(1, 1))

    def random_parameters(self) -> list[RandomParameter]:
        """Return the delay."""
        return [self.queue.random_parameter("action_delay")]

    def state_dict(self) -> dict[str, Any]:
        """Return the packets and the delays."""
        return self.queue.state_dict()

    def describe(self) -> dict[str, Any]:
        """Return the range with its unit, jitter and loss."""
        return self.cfg.described() if self.queue.is_needed else {}
