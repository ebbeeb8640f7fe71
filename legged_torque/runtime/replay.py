"""A log once more: the policy on what it saw, and a simulated robot under the same commands."""

from dataclasses import dataclass

import numpy as np

from legged_torque.deploy.policy import Policy
from legged_torque.runtime.interface import Received
from legged_torque.runtime.log import RecordedLog
from legged_torque.runtime.sim_robot import SimRobot
from legged_torque.utils.errors import UserError


def same_actions(log: RecordedLog, policy: Policy) -> tuple[int, int]:
    """Return how many steps of the policy a log has, and in how many it does now what it did then, bit by bit.

    A UserError if it is another policy.
    """
    if policy.description["network"]["sha256"] != log.sha256:
        raise UserError("the log is of another policy: the networks' checksums differ")
    equal = []
    for step in log.policy_steps():
        if step.is_first:
            policy.reset()
        equal.append(np.array_equal(policy.act(step.observations), step.actions))
    return len(equal), sum(equal)


@dataclass
class Gap:
    """How far a simulated robot is from the one of a log, which got the same commands.

    Attributes:
        times: Of the ticks since the first [s]. Shape: (ticks,).
        logged, simulated: Joint positions [rad]. Shapes: (ticks, joints).
    """

    times: np.ndarray
    logged: np.ndarray
    simulated: np.ndarray

    def parts_at(self, limit: float) -> np.ndarray:
        """Return when each joint is first more than ``limit`` [rad] off [s]; infinity if never. Shape: (joints,)."""
        is_off = np.abs(self.simulated - self.logged) > limit
        return np.where(is_off.any(axis=0), self.times[is_off.argmax(axis=0)], np.inf)

    def rms(self, end: float) -> np.ndarray:
        """Return the root mean square of the gap up to a time [s], in rad. Shape: (joints,)."""
        return np.sqrt(np.square(self.simulated - self.logged)[self.times <= end].mean(axis=0))


def simulate(log: RecordedLog, robot: SimRobot) -> Gap:
    """Give a simulated robot, which begins in the first state of the log, all commands of the log, each in time.

    Where the program was late, a robot that keeps time has gone on under the command before. Ticks without a state are
    not compared. A UserError if the log has no states.
    """
    times, logged, simulated = [], [], []
    has_begun, start = False, 0.0
    for time, newest, command, _ in log.ticks():
        if newest is not None and not has_begun:
            robot.lie_down(newest.joint_positions, newest.quaternion)
            has_begun, start = True, time
        if has_begun and log.keeps_time:
            for _ in range(round((time - start - robot.data.time) / log.period)):
                robot.step(Received())
        said, _ = robot.says()
        if newest is not None and said is not None:
            times.append(time)
            logged.append(newest.joint_positions)
            simulated.append(said.joint_positions)
        robot.step(Received(command))
    if not times:
        raise UserError("the log has no states of a robot")
    return Gap(np.array(times) - times[0], np.array(logged), np.array(simulated))
