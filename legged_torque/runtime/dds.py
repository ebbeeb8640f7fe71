"""Unitree's low-level topics over DDS: a robot as the program sees it, and a simulated robot's own side."""

import math
import socket
import time
from collections.abc import Callable
from typing import Any
from xml.sax.saxutils import quoteattr

from legged_torque.runtime.interface import JOINT_ORDER, MotorCommand, Received, RobotState
from legged_torque.utils.errors import UserError, check_names

try:
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.internal import InvalidSample
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from legged_torque.runtime import unitree_go2
    from legged_torque.runtime.motion_switcher import SERVICE, Release, Request_, Response_, SportMode
    from legged_torque.runtime.unitree_go2 import LowCmd_, LowState_, Message
except ImportError as error:
    raise UserError(f"DDS needs the extra: pip install 'legged_torque[robot]' ({error})") from None

TOPICS: dict[type, str] = {LowCmd_: "rt/lowcmd", LowState_: "rt/lowstate", **SERVICE}
DEPTH = 32  # messages that wait for the next look; at 500 Hz, 64 ms
QUIET = 0.5  # seconds without commands of another program after which it counts as ended
NUMBERS = 2**32  # numbers of messages start anew after these
READER = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(DEPTH), Policy.IgnoreLocal.Participant)
"""A message that is lost is never sent again: the next one is newer. Fits any writer but this side's own."""
WRITER = Qos(
    Policy.Reliability.Reliable(max_blocking_time=0),  # fits any reader
    Policy.History.KeepLast(1),
    Policy.DataRepresentation(use_cdrv0_representation=True),  # what Unitree's version of Cyclone DDS writes
)


def configuration(interface: str) -> str:
    """Return Cyclone DDS's settings for one network interface; loopback is searched without multicast."""
    network = f"<NetworkInterface name={quoteattr(interface)}"
    general, discovery = f"<Interfaces>{network}/></Interfaces>", ""
    if interface == "lo":
        general = f"<Interfaces>{network} multicast='false'/></Interfaces><AllowMulticast>false</AllowMulticast>"
        discovery = "<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers>"
    domain = f"<General>{general}</General><Discovery>{discovery}</Discovery>"
    return f"<CycloneDDS><Domain>{domain}</Domain></CycloneDDS>"


def _taken(reader: DataReader) -> list[Any]:
    """Return the newest messages, without those that say that the other side has left."""
    return [message for message in reader.take(N=DEPTH) if not isinstance(message, InvalidSample)]


class _Side:
    """One of two sides: publishes one topic and reads the other, and has an end of the motion switcher's service.

    Nothing here waits. The settings of CYCLONEDDS_URI are not read, so that ``interface`` is the one that is used.
    """

    joint_order = JOINT_ORDER
    writes: tuple[type, type]  # types of this side's messages and of its end of the service
    reads: tuple[type, type]  # of the other side
    decode: Callable[[Any], RobotState | MotorCommand]  # returns the contents of a message
    number: str  # name of the field that numbers the messages; 0 in all of them says that they have no numbers
    step: int  # by how much the number grows from message to message

    def __init__(self, interface: str, domain: int) -> None:
        """Join a domain: of Unitree's robots 0, of unitree_mujoco 1. One side per process and domain.

        A UserError if there is no such network interface, or DDS cannot use it or the domain.
        """
        check_names("network interface", [interface], [name for _, name in socket.if_nameindex()])
        try:
            self._domain = Domain(domain, configuration(interface))
            here = self._participant = DomainParticipant(domain)
            topics = {kind: Topic(here, TOPICS[kind], kind) for kind in (*self.writes, *self.reads)}
            self._writer, self._service_writer = (DataWriter(here, topics[kind], WRITER) for kind in self.writes)
            self._reader, self._service_reader = (DataReader(here, topics[kind], READER) for kind in self.reads)
        except DDSException as error:
            rule = "the interface must be up, the domain from 0 to 232, and used once in this process"
            raise UserError(f"no DDS on interface '{interface}' in domain {domain}: {rule} ({error.msg})") from None
        self._senders: list[int] = []  # of messages so far, the last one at the end
        self._newest = 0

    def receive(self) -> Received:
        """Return what has come since the last call: at most the newest DEPTH messages, those before are lost.

        A message that is refused is missing by its number, too. Repeated messages count as late.
        """
        received = Received()
        for message in _taken(self._reader):
            try:
                contents = type(self).decode(message)
            except unitree_go2.CrcError:
                received.wrong_crc += 1
            except unitree_go2.MessageError as error:
                received.problems.append(str(error))
            else:
                if self._is_newest(message, received):
                    received.newest = contents
        return received

    def _is_newest(self, message: Message, received: Received) -> bool:
        """Return whether a message is newer than all of its sender before it; counts what is lost and late."""
        sender, number = message.sample_info.publication_handle, message[self.number]
        if sender not in self._senders[-1:]:
            if sender in self._senders:
                received.problems.append(f"two programs send {TOPICS[self.reads[0]]}")
                self._senders.remove(sender)
            self._senders.append(sender)
            self._newest = 0
        if self._newest and number:
            ahead = (number - self._newest) % NUMBERS
            if not 0 < ahead < NUMBERS // 2:
                received.late += 1
                return False
            received.lost += max(ahead // self.step - 1, 0)
        self._newest = number
        return True

    def close(self) -> None:
        """Leave the domain."""
        self._reader = self._writer = self._service_reader = self._service_writer = None
        self._participant = self._domain = None

    def publish(self, message: Message) -> None:
        """Send a message as it is."""
        self._writer.write(message)


class Go2Robot(_Side):
    """A robot, real or simulated, as the program sees it: a :class:`~legged_torque.runtime.interface.Transport`.

    States are numbered by ``tick`` in milliseconds: a gap of two periods is a lost message. While the robot's sport
    mode is not released, that is a problem, and no command is sent. Its service must answer in domain 0, that of
    Unitree's robots; in others it may be missing, as in unitree_mujoco. A new sender of states is asked anew. Until it
    answers, damping is sent: it may be another program next to a robot that walks. While another program commands the
    robot, that is a problem, too: then damping is sent, or nothing by a program that has not begun. It listens before.
    Another firmware or serial number than that of the first state is a problem to the end.
    """

    torque_limits = [23.7, 23.7, 45.43] * 4  # of hips, thighs and calves [N m]
    writes, reads = (LowCmd_, Request_), (LowState_, Response_)
    decode, number, step = staticmethod(unitree_go2.decode_state), "tick", unitree_go2.STATE_PERIOD

    def __init__(self, interface: str, domain: int) -> None:
        """Join the robot's domain; arguments and errors are those of the base class."""
        super().__init__(interface, domain)
        self._sent, self._release = 0, Release(self._service_writer.write, is_optional=domain != 0)
        self._others = DataReader(self._participant, self._writer.topic, READER)  # commands that are not this program's
        self._joined, self._others_heard = time.monotonic(), -math.inf
        self._identity: Any = None  # of the first state
        self._exchanged, self._problems = "", [self._release.problem]

    def receive(self) -> Received:
        """Return what has come, and ask for what is missing."""
        known, received = len(self._senders), super().receive()
        if len(self._senders) > known:
            self._release.begin()
        if self._release.problem:
            self._release.look(_taken(self._service_reader), time.monotonic())
        now = time.monotonic()
        if _taken(self._others):
            self._others_heard = now
        others = "" if now - self._joined > QUIET else "listening for other programs"
        if now - self._others_heard < QUIET:
            others = f"another program sends {TOPICS[LowCmd_]}"
        if isinstance(state := received.newest, RobotState):
            self._identity = state.identity if self._identity is None else self._identity
            if (state.identity != self._identity).any():
                self._exchanged = "another firmware or serial number than in the first state: start deploy.py anew"
        self._problems = [problem for problem in (self._release.problem, others, self._exchanged) if problem]
        received.problems += self._problems
        return received

    def send(self, command: MotorCommand) -> None:
        """Tell the drives, once they are free; raises MessageError if a number is not finite."""
        is_damping = not (command.kp.any() or command.tau.any())
        if not self._problems or (self._sent and is_damping and not self._release.mode):
            self._sent = self._sent % (NUMBERS - 1) + 1  # never 0
            self.publish(unitree_go2.encode_command(command, self._sent))

    def close(self) -> None:
        """Leave the domain."""
        self._others = None
        super().close()


class Go2Side(_Side):
    """The side of a simulated robot: tells states, and reads commands once its sport mode has been released."""

    writes, reads = (LowState_, Response_), (LowCmd_, Request_)
    decode, number, step = staticmethod(unitree_go2.decode_command), "reserve", 1

    def __init__(self, interface: str, domain: int) -> None:
        """Join the domain; arguments and errors are those of the base class."""
        super().__init__(interface, domain)
        self.sport_mode = SportMode()

    def receive(self) -> Received:
        """Return what has come; a command in the sport mode is a problem, and not obeyed."""
        received = super().receive()
        if self.sport_mode.name and received.newest:
            received.newest = None
            received.problems.append(f"a command in the sport mode '{self.sport_mode.name}'")
        for request in _taken(self._service_reader):
            self._service_writer.write(self.sport_mode.answer(request))
        return received

    def send(self, state: RobotState, is_damaged: bool = False) -> None:
        """Tell the program, with a wrong checksum if asked to; raises MessageError if a number is not finite."""
        message = unitree_go2.encode_state(state)
        message["crc"] ^= is_damaged
        self.publish(message)
