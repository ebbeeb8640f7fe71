"""Both sides of a robot over DDS: two processes on loopback."""

import importlib
import os
import struct
import subprocess
import sys
import time
from collections import deque
from contextlib import contextmanager

import mujoco
import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the extra: pip install 'legged_torque[robot]'")

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from legged_torque import resource_path
from legged_torque.runtime import motion_switcher
from legged_torque.runtime import unitree_go2 as go2
from legged_torque.runtime.dds import QUIET, WRITER, Go2Robot, Go2Side
from legged_torque.runtime.interface import MotorCommand
from legged_torque.runtime.motion_switcher import Release, SportMode
from legged_torque.utils.errors import UserError

DOMAIN = 100 + os.getpid() % 100  # each worker of pytest has its own
OTHER_SIDE = """
import sys, time
import numpy as np
from legged_torque.runtime import unitree_go2
from legged_torque.runtime.dds import Go2Side
from legged_torque.runtime.interface import RobotState

side = Go2Side("lo", int(sys.argv[1]))
for line in sys.stdin:  # numbers of the states to tell, 500 a second; of a negative one the CRC is wrong
    start = time.monotonic()
    for k, number in enumerate(int(word) for word in line.split()):
        time.sleep(max(0.0, start + k / 500 - time.monotonic()))
        firmware, tick = divmod(abs(number), 10_000)
        measured = (np.zeros(4), np.zeros(3), *np.zeros((5, 12)), np.full(4, firmware))
        message = unitree_go2.encode_state(RobotState(tick, *measured))
        message["crc"] ^= number < 0
        side.publish(message)
    heard = side.receive()
    tau = heard.newest.tau[0] if heard.newest else np.nan
    print(tau, heard.lost, heard.late, heard.wrong_crc, len(heard.problems), flush=True)
"""


class Robot:
    """The other process."""

    def __init__(self):
        arguments = [sys.executable, "-c", OTHER_SIDE, str(DOMAIN)]
        self.process = subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def tell(self, numbers):
        """Have it tell states."""
        print(*numbers, file=self.process.stdin, flush=True)

    def heard(self):
        """After it has told all: torque of the newest command, lost, late, with a wrong CRC, other problems."""
        return [float(word) for word in self.process.stdout.readline().split()]

    def told(self, numbers, transport):
        """What is received of states that it tells."""
        self.tell(numbers)
        self.heard()
        return looks(transport, 0.2)

    def meet(self, transport):
        """Wait until both sides have found each other, with messages of number 0, and the sport mode is released."""
        for _ in range(200):
            self.tell([0])
            transport.publish(numbered(0))
            found, heard = looks(transport, 0.03), self.heard()
            if heard[0] == 0 and any(look.newest for look in found) and not found[-1].problems:
                return
        pytest.fail("the two sides have not met")


@contextmanager
def started():
    """A robot, which leaves at the end."""
    robot = Robot()
    try:
        yield robot
    finally:
        robot.process.communicate(timeout=10)


@pytest.fixture
def transport():
    """This process's side."""
    transport = Go2Robot("lo", DOMAIN)
    yield transport
    transport.close()


@pytest.fixture
def robot(transport):
    """A robot that has been met."""
    with started() as robot:
        robot.meet(transport)
        yield robot


def torques(value):
    """A command of one torque."""
    idle = np.full(12, go2.NO_POSITION), np.full(12, go2.NO_VELOCITY), np.zeros(12), np.zeros(12)
    return MotorCommand(np.full(12, value), *idle)


def numbered(number):
    """The message of a command whose torque is its number; of a negative one the CRC is wrong."""
    message = go2.encode_command(torques(abs(number)), abs(number))
    message["crc"] ^= number < 0
    return message


def heard_of(robot, transport, *sent):
    """The torque that the robot has heard last, of those that were sent; nan if it has heard nothing."""
    for value in sent:
        transport.send(torques(value))
    time.sleep(0.2)
    robot.tell([])
    return robot.heard()[0]


def looks(transport, seconds):
    """What is received within a time, a look per millisecond."""
    end, found = time.monotonic() + seconds, []
    while time.monotonic() < end:
        found.append(transport.receive())
        time.sleep(0.001)
    return found


def counts(found):
    """Lost and late messages, and those with a wrong CRC, of several looks."""
    return [sum(getattr(look, name) for look in found) for name in ("lost", "late", "wrong_crc")]


def test_states_arrive_in_order(robot, transport):
    """A second at 500 Hz: later looks find later states up to the last; what a busy machine loses is counted."""
    robot.tell(range(2, 502))
    found, end = [], time.monotonic() + 10
    while not (found and found[-1].newest and found[-1].newest.tick == 501) and time.monotonic() < end:
        found += looks(transport, 0.001)
    numbers = [look.newest.tick for look in found if look.newest]
    assert numbers == sorted(set(numbers)) and numbers[-1] == 501
    lost, late, wrong_crc = counts(found)
    assert 100 < len(numbers) <= 500 - lost
    assert late == wrong_crc == 0 and not any(look.problems for look in found)


FAULTS = {
    "none": ([2, 3, 4], [0, 0, 0]),
    "dropped": ([2, 5, 6, 8], [3, 0, 0]),
    "twice": ([2, 3, 3, 4], [0, 1, 0]),
    "out of order": ([2, 4, 3, 5], [1, 1, 0]),
    "damaged": ([2, -3, 4], [1, 0, 1]),
}


def test_faults_are_counted(robot, transport):
    """On both sides: lost, late or repeated, and damaged messages; the newest whole one stays."""
    last = 0
    for name, (numbers, expected) in FAULTS.items():  # each goes on where the one before has ended
        numbers = [number + (last if number > 0 else -last) for number in numbers]
        last = numbers[-1] - 1
        found = robot.told(numbers, transport)
        assert counts(found) == expected, name
        assert [look.newest.tick for look in found if look.newest][-1] == numbers[-1]
        for number in numbers:
            transport.publish(numbered(number))
        time.sleep(0.2)
        robot.tell([])
        assert robot.heard() == [numbers[-1], *expected, 0], name


def test_commands_are_numbered(robot, transport):
    """What `send` numbers has no gap; messages of Unitree's own programs have no numbers, and are obeyed."""
    for torque in (1.0, 2.0, 3.0):
        transport.send(torques(torque))
    time.sleep(0.2)
    robot.tell([])
    tau, lost, _, wrong_crc, problems = robot.heard()
    assert [tau, lost, wrong_crc, problems] == [3, 0, 0, 0]
    for torque in (4.0, 5.0):
        transport.publish(go2.encode_command(torques(torque), 0))
    time.sleep(0.2)
    robot.tell([])
    assert robot.heard() == [5, 0, 0, 0, 0]


def test_the_sport_mode_is_released_first(transport, monkeypatch):
    """Before, a robot refuses commands, and none is sent; a robot that starts anew is asked anew."""
    for _ in range(2):
        with started() as robot:
            heard = [np.nan, 0, 0, 0, 0]
            for _ in range(200):  # until they have found each other
                if not heard[4]:
                    transport.publish(numbered(7))
                    robot.tell([0])
                    heard = robot.heard()
            assert np.isnan(heard[0]) and heard[4]
            with monkeypatch.context() as patch:
                patch.setattr(transport, "publish", lambda message: pytest.fail("a command is sent"))
                assert any("does not answer" in look.problems[0] for look in looks(transport, 0.05) if look.newest)
                transport.send(torques(1.0))
            robot.meet(transport)
            transport.send(torques(2.0))
            time.sleep(0.2)
            robot.tell([])
            assert robot.heard()[0] == 2.0


def test_a_robot_that_leaves(transport):
    """The news that nobody tells states any more is no state, and no error."""
    with started() as robot:
        robot.meet(transport)
    assert not any(look.newest for look in looks(transport, 0.5)[-10:])


def test_answers_of_the_motion_switcher():
    """A mode is released; stale answers, errors and those that cannot be read release nothing. Requests are CDR."""
    sent, service = [], SportMode()
    release = Release(sent.append, is_optional=False)
    for now, answered, problem, count in (
        (0.0, [], "the motion switcher does not answer", 1),
        (0.1, [0], "the sport mode 'normal' holds the motors", 2),
        (0.2, [1, 0], "the sport mode 'normal' holds the motors", 2),
        (0.35, [], "the sport mode 'normal' holds the motors", 3),
        (0.4, [2], "", 3),
    ):
        release.look([service.answer(sent[i]) for i in answered], now)
        assert (release.problem, len(sent)) == (problem, count) and bool(release.mode) == ("holds" in problem)
    for code, data, said in ((3104, "", "error 3104"), (0, "{", "'{'"), (0, '{"form": 0}', "form")):
        release.begin()
        release.look([], 1.0)
        response = service.answer(sent[-1])
        response.header.status.code, response.data = code, data
        release.look([response], 1.1)
        assert said in release.problem
    for is_optional in (True, False):  # of a simulator without the service
        release = Release(sent.append, is_optional)
        for now in (5.0, 6.9, 7.1):
            release.look([], now)
            assert bool(release.problem) == (now < 7.0 or not is_optional)
    number = sent[0].header.identity.id  # two of 64 bits, one for the lease, priority, a flag; text; an empty sequence
    assert sent[0].serialize()[4:] == struct.pack("<qqqi?3xI3sxI", number, 1001, 0, 0, False, 3, b"{}", 0)


@pytest.mark.parametrize("late", [0.5, 1.9])
def test_slow_answers_of_the_motion_switcher(late):
    """A service that takes so long [s] is not taken for none, and releases its mode once."""
    service, sent, coming, now = SportMode(), [], deque(), 0.0

    def answer(request):
        sent.append(request.header.identity.api_id)
        coming.append((now + late, service.answer(request)))

    release = Release(answer, is_optional=True)
    for now in np.arange(0.0, 3 * late, 0.01):
        release.look([coming.popleft()[1] for due, _ in [*coming] if due <= now] if release.problem else [], now)
        assert release.problem or not service.name
    assert not release.problem and sent.count(1003) == 1


@pytest.mark.parametrize("domain", [0, 230])
def test_where_a_robot_need_not_have_a_motion_switcher(domain, monkeypatch):
    """Not in the domain of Unitree's robots, whatever the interface."""
    monkeypatch.setattr(motion_switcher, "ABSENT", 0.1)
    transport = Go2Robot("lo", domain)
    found = looks(transport, QUIET + 0.1)
    transport.close()
    assert bool(found[-1].problems) == (domain == 0)


def test_another_firmware(robot, transport):
    """Is known by the first state, and a problem to the end once a state tells of another: the robot only damps."""
    assert not any(look.problems for look in robot.told([2], transport)) and heard_of(robot, transport, 1.0) == 1.0
    found = [look for number in (10_003, 4) for look in robot.told([number], transport)]
    assert [look.newest.identity.tolist() for look in found if look.newest] == [[1] * 4, [0] * 4]
    assert "firmware or serial number" in found[-1].problems[0]
    assert heard_of(robot, transport, 0.0, 2.0) == 0.0


def test_torque_limits():
    """They are those of the bundled model."""
    model = mujoco.MjModel.from_xml_path(str(resource_path("resources/robots/go2/go2.xml")))
    known = zip(go2.JOINT_ORDER, Go2Robot.torque_limits, strict=True)
    assert all(model.actuator(joint.removesuffix("_joint")).forcerange[1] == most for joint, most in known)


def test_robots_that_start_anew_and_two_at_once(transport):
    """The numbers of a robot that has started again are its own; two robots at the same time are a problem."""
    with started() as first:
        first.meet(transport)
        first.told([900], transport)
        with started() as second:
            second.meet(transport)
            found = second.told([2, 3], transport)
            assert counts(found) == [0, 0, 0] and not any(look.problems for look in found)
            found = first.told([901], transport)
            assert any("rt/lowstate" in problem for look in found for problem in look.problems)


def test_another_program_next_to_a_robot(robot, transport):
    """A robot that walks is only damped until the motion switcher has answered again, and always hears of it."""
    assert heard_of(robot, transport, 5.0) == 5.0
    with started() as other:
        found = []
        while not any(look.problems for look in found):
            other.tell([0])
            other.heard()
            found = looks(transport, 0.03)
        assert heard_of(robot, transport, 0.0, 1.0) == 0.0  # then its motion switcher has answered
        for program in (robot, other, robot):
            said = [problem for look in program.told([0], transport) for problem in look.problems]
            assert said == ["two programs send rt/lowstate"] and heard_of(robot, transport, 3.0) == 3.0


def test_another_program_that_commands(robot, transport):
    """While another program sends commands, one that has sent some damps the robot, and one that has not is silent."""
    participant = DomainParticipant(DOMAIN)
    other = DataWriter(participant, Topic(participant, "rt/lowcmd", go2.LowCmd_), WRITER)

    def said():
        """What the program says once it has heard the other."""
        problems = set()
        for _ in range(100):
            other.write(numbered(0))
            problems |= {problem for look in looks(transport, 0.03) for problem in look.problems}
            if problems:
                break
        heard_of(robot, transport)
        return problems

    for is_silent in (True, False):
        assert said() == {"another program sends rt/lowcmd"}
        assert np.isnan(heard_of(robot, transport, 5.0))
        damping = heard_of(robot, transport, 0.0)
        assert np.isnan(damping) if is_silent else damping == 0.0
        assert not looks(transport, QUIET + 0.1)[-1].problems
        assert heard_of(robot, transport, 7.0) == 7.0


def test_nobody_there(transport, monkeypatch):
    """Neither side waits for the other, and settings of the user's for other programs are not read."""
    start = time.monotonic()
    for _ in range(100):
        transport.send(torques(0.0))
        assert transport.receive().newest is None
    assert time.monotonic() - start < 1.0  # the robot's rate is 500 Hz
    transport.close()
    monkeypatch.setenv("CYCLONEDDS_URI", "<no settings")
    Go2Side("lo", DOMAIN).close()


@pytest.mark.parametrize(
    ("interface", "domain", "said"),
    [("l0", 1, "'l0'; did you mean 'lo'"), ("lo", 233, "233"), ("lo", DOMAIN, "process")],
    ids=["no interface", "no domain", "taken"],
)
def test_what_dds_cannot_use(transport, interface, domain, said):
    """An interface that does not exist, a domain too high, and one that this process is in already, are refused."""
    with pytest.raises(UserError, match=said) as error:
        Go2Side(interface, domain)
    assert "\n" not in str(error.value)


def test_missing_package(monkeypatch):
    """Without cyclonedds, one line names the extra."""
    monkeypatch.delitem(sys.modules, "legged_torque.runtime.dds")
    monkeypatch.setitem(sys.modules, "cyclonedds.core", None)
    with pytest.raises(UserError, match=r"^[^\n]*'legged_torque\[robot\]'[^\n]*$"):
        importlib.import_module("legged_torque.runtime.dds")
