"""Unitree's low-level topics over DDS: a robot as the program sees it, and a simulated robot's own side."""

import socket
from collections.abc import Callable
from typing import Any
from xml.sax.saxutils import quoteattr

from legged_torque.runtime.interface import MotorCommand, Received, RobotState
from legged_torque.utils.errors import UserError, unknown_name

try:
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.internal import InvalidSample
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from legged_torque.runtime import unitree_go2
    from legged_torque.runtime.unitree_go2 import LowCmd_, LowState_
except ImportError as error:
    raise UserError(f"DDS needs the extra: pip install 'legged_torque[robot]' ({error})") from None

TOPICS: dict[type, str] = {LowCmd_: "rt/lowcmd", LowState_: "rt/lowstate"}
DEPTH = 32  # messages that wait for the next look; at 500 Hz, 64 ms
NUMBERS = 2**32  # numbers of messages start anew after these
READER = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(DEPTH))
"""A message that is lost is never sent again: the next one is newer. Fits any writer."""
WRITER = Qos(
    Policy.Reliability.Reliable(max_blocking_time=0),  # fits any reader
    Policy.History.KeepLast(1),
    Policy.DataRepresentation(use_cdrv0_representation=True),  # what Unitree's version of Cyclone DDS writes
)


def configuration(interface: str) -> str:
    """Return Cyclone DDS's settings for one network interface; loopback is searched without multicast."""
    network = f"<NetworkInterface name={quoteattr(interface)}"
    if interface != "lo":
        return f"<CycloneDDS><Domain><General><Interfaces>{network}/></Interfaces></General></Domain></CycloneDDS>"
    general = f"<Interfaces>{network} multicast='false'/></Interfaces><AllowMulticast>false</AllowMulticast>"
    discovery = "<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers>"
    domain = f"<General>{general}</General><Discovery>{discovery}</Discovery>"
    return f"<CycloneDDS><Domain>{domain}</Domain></CycloneDDS>"


class _Side:
    """One of two sides: publishes one topic and reads the other. Nothing here waits.

    The settings of CYCLONEDDS_URI are not read, so that ``interface`` is the one that is used.

    Args:
        interface: Name of the network interface.
        domain: Number of the DDS domain; of Unitree's robots 0, of unitree_mujoco 1. One side per process and domain.
        writes: Type of the messages that this side publishes.
        reads: Type of the messages of the other side.
        decode: What returns the contents of a message.
        number: Name of the field that numbers the messages; 0 in all of them says that they have no numbers.
        step: By how much the number grows from message to message.

    Raises:
        UserError: If there is no such interface, or DDS cannot use it or the domain.
    """

    joint_order = unitree_go2.JOINT_ORDER

    def __init__(
        self,
        interface: str,
        domain: int,
        *,
        writes: type,
        reads: type,
        decode: Callable[[Any], RobotState | MotorCommand],
        number: str,
        step: int,
    ) -> None:
        """Join the domain."""
        names = [name for _, name in socket.if_nameindex()]
        if interface not in names:
            raise unknown_name("network interface", interface, names)
        try:
            self._domain = Domain(domain, configuration(interface))
            self._participant = DomainParticipant(domain)
            self._writer = DataWriter(self._participant, self._topic(writes), WRITER)
            self._reader = DataReader(self._participant, self._topic(reads), READER)
        except DDSException as error:
            rule = "the interface must be up, the domain from 0 to 232, and used once in this process"
            raise UserError(f"no DDS on interface '{interface}' in domain {domain}: {rule} ({error.msg})") from None
        self._reads, self._decode, self._number, self._step = TOPICS[reads], decode, number, step
        self._senders: list[int] = []  # of messages so far, the last one at the end
        self._newest = 0

    def _topic(self, kind: type) -> Topic:
        return Topic(self._participant, TOPICS[kind], kind)

    def receive(self) -> Received:
        """Return what has come since the last call: at most the newest DEPTH messages, those before are lost.

        A message that is refused is missing by its number, too. Repeated messages count as late.
        """
        received = Received()
        for message in self._reader.take(N=DEPTH):
            if isinstance(message, InvalidSample):
                continue  # the other side has left
            try:
                contents = self._decode(message)
            except unitree_go2.CrcError:
                received.wrong_crc += 1
            except unitree_go2.MessageError as error:
                received.problems.append(str(error))
            else:
                if self._is_newest(message, received):
                    received.newest = contents
        return received

    def _is_newest(self, message: LowCmd_ | LowState_, received: Received) -> bool:
        """Return whether a message is newer than all of its sender before it; counts what is lost and late."""
        sender, number = message.sample_info.publication_handle, getattr(message, self._number)
        if sender not in self._senders[-1:]:
            if sender in self._senders:
                received.problems.append(f"two programs send {self._reads}")
                self._senders.remove(sender)
            self._senders.append(sender)
            self._newest = 0
        if self._newest and number:
            ahead = (number - self._newest) % NUMBERS
            if not 0 < ahead < NUMBERS // 2:
                received.late += 1
                return False
            received.lost += max(ahead // self._step - 1, 0)
        self._newest = number
        return True

    def publish(self, message: LowCmd_ | LowState_) -> None:
        """Send a message as it is."""
        self._writer.write(message)

    def close(self) -> None:
        """Leave the domain."""
        self._reader = self._writer = self._participant = self._domain = None


class Go2Robot(_Side):
    """A robot, real or simulated, as the program sees it: a :class:`~legged_torque.runtime.interface.Transport`.

    States are numbered by ``tick`` in milliseconds: a gap of two periods is a lost message.
    """

    def __init__(self, interface: str, domain: int) -> None:
        """Join the robot's domain; arguments and errors are those of the base class."""
        super().__init__(
            interface,
            domain,
            writes=LowCmd_,
            reads=LowState_,
            decode=unitree_go2.decode_state,
            number="tick",
            step=unitree_go2.STATE_PERIOD,
        )
        self._sent = 0

    def send(self, command: MotorCommand) -> None:
        """Tell the drives; raises MessageError if a number is not finite."""
        self._sent = self._sent % (NUMBERS - 1) + 1  # never 0
        self.publish(unitree_go2.encode_command(command, self._sent))


class Go2Side(_Side):
    """The side of a simulated robot: reads commands, tells states."""

    def __init__(self, interface: str, domain: int) -> None:
        """Join the domain; arguments and errors are those of the base class."""
        super().__init__(
            interface,
            domain,
            writes=LowState_,
            reads=LowCmd_,
            decode=unitree_go2.decode_command,
            number="reserve",
            step=1,
        )

    def send(self, state: RobotState) -> None:
        """Tell the program; raises MessageError if a number is not finite."""
        self.publish(unitree_go2.encode_state(state))
