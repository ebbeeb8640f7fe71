"""A simulated robot in step with its controller, shared by tests of the runtime."""

from legged_torque import resource_path
from legged_torque.runtime.brakes import Brakes
from legged_torque.runtime.controller import Controller, Mode
from legged_torque.runtime.session import Session
from legged_torque.runtime.sim_robot import InProcess, SimRobot

RATE = 500.0


def robot_of(policy, order=None, rate=RATE, **options):
    """The robot that a policy was trained for, lying; it has an order of joints of its own."""
    return SimRobot(resource_path(policy.description["robot"]["file"]), order or policy.joint_order, rate, **options)


class Simulated(Session):
    """A session in simulated time.

    Attributes:
        took: Seconds from the beginning of a tick until its command is sent.
    """

    now = took = 0.0

    def __init__(self, *args):
        super().__init__(*args, clock=lambda: self.now + self.took)

    def tick(self, now, missed, late=0.0):
        """A tick of that time."""
        self.now = now
        super().tick(now, missed, late)


class World(Simulated):
    """A robot, its controller, and the time in ticks."""

    def __init__(self, policy, brakes=None):
        order = list(reversed(policy.joint_order))
        self.robot, self.ticks = robot_of(policy, order), 0
        super().__init__(Controller(policy, order, RATE, brakes), InProcess(self.robot))

    def run(self, ticks, missed=False):
        """Some ticks; the mode at the end."""
        for _ in range(ticks):
            self.ticks += 1
            self.tick(self.ticks / RATE, missed)
        return self.controller.mode

    def stand(self):
        """Stand up from lying."""
        self.run(5)
        assert self.controller.request(Mode.STAND) == ""
        self.run(round(3.5 * RATE))
        return self


def standing_at_once(policy):
    """A world in which standing up takes no time."""
    world = World(policy, Brakes(stand_up=0.01))
    world.robot.lie_down(policy.nominal_pose[::-1])
    world.run(5)
    return world
