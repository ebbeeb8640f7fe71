"""A simulated robot in the same process, for a first try and for tests: it has no wire, and no time of its own."""

import numpy as np

from legged_torque.runtime.interface import MotorCommand, Received
from legged_torque.runtime.sim_robot import SimRobot


class InProcess:
    """A :class:`SimRobot` as a transport: it moves on with each command.

    Attributes:
        robot: The robot.
        joint_order: Names of its joints.
        torque_limits: Of its motors [N m].
    """

    def __init__(self, robot: SimRobot) -> None:
        """Take the robot."""
        self.robot, self.joint_order = robot, robot.joint_order
        self.torque_limits = np.abs(robot.limits).max(axis=0).tolist()
        self._tick = 0

    def receive(self) -> Received:
        """Return what the robot says."""
        state, is_damaged = self.robot.says()
        if state is None or is_damaged:
            return Received(wrong_crc=int(is_damaged and state is not None))
        lost, self._tick = max(state.tick - self._tick - 1, 0), state.tick
        return Received(state, lost=lost)

    def send(self, command: MotorCommand) -> None:
        """Let the robot move on under a command."""
        self.robot.step(Received(command))

    def close(self) -> None:
        """Do nothing."""
