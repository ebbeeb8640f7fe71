"""Unitree's messages for Go2 and newer robots: what goes over the wire, and its CRC.

Names, order and sizes of the fields are those of Unitree's SDK (unitree_sdk2_python, ``idl/unitree_go/msg/dds_``), as
DDS connects only sides whose types are the same. Structure and CRC: ``utils/crc.py`` there. A message is the list of
its numbers: objects for all its parts would take half of the control loop's time.
"""

import struct
import zlib
from typing import Any, ClassVar

import numpy as np
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import array, byte, float32, int16, int32, uint16, uint32
from numpy.typing import ArrayLike

from legged_torque.runtime.interface import JOINT_ORDER, NO_POSITION, NO_VELOCITY, MotorCommand, RobotState

SLOTS = 20  # motors in a message; those after the legs' 12 are idle
HEAD = (0xFE, 0xEF)
UNSET = (0, 0)  # unitree_mujoco sets neither the head nor the modes of its states
LOW_LEVEL = 0xFF
SERVO = 0x01  # mode of a motor
COMMANDED = ("tau", "q", "dq", "kp", "kd")
MEASURED = {"joint_positions": "q", "joint_velocities": "dq", "joint_torques": "tau_est", "temperatures": "temperature"}
"""What RobotState calls the members of a motor's state."""
STATE_PERIOD = 2  # ms: a Go2 tells its state 500 times a second, and ``tick`` counts milliseconds


class MessageError(Exception):
    """A message that must not move a motor; says why."""


class CrcError(MessageError):
    """A message that was damaged on its way."""


class Message:
    """A message: ``message["imu_state.gyroscope"]`` are its numbers of that name; of motors, those of the legs.

    Attributes:
        numbers: All of them, in order.
        places: Their indices or slices, by name; of an array of each motor, that of its first number.
        size: How many there are.
        blank: Those of a message that says nothing.
        c_layout: The C structure of Unitree's SDK, little endian; the last four bytes are the CRC.
        cdr_layouts: DDS's own form, which has less padding, by the first bytes that say its order of bytes.
        sample_info: What cyclonedds knows about a message that has come.
    """

    places: ClassVar[dict[str, Any]]
    size: ClassVar[int]
    blank: ClassVar[list[Any]]
    c_layout: ClassVar[struct.Struct]
    cdr_layouts: ClassVar[dict[bytes, struct.Struct]]
    sample_info: Any

    def __init__(self, numbers: list[Any] | None = None) -> None:
        """Make a message of all its numbers, or one without any but those that are always the same."""
        self.numbers = numbers or self.blank.copy()

    def __getitem__(self, name: str) -> Any:
        """Return a number, or a list of them."""
        return self.numbers[self.places[name]]

    def __setitem__(self, name: str, values: Any) -> None:
        """Set a number, or as many as there are."""
        self.numbers[self.places[name]] = values

    def serialize(self, use_version_2: bool | None = None) -> bytes:
        """Return the message in DDS's form, as cyclonedds calls it."""
        return _CDR + self.cdr_layouts[_CDR[:2]].pack(*self.numbers)

    @classmethod
    def deserialize(cls, data: bytes) -> "Message":
        """Return a message from DDS's form; from any other, a blank one, whose CRC is wrong."""
        layout = cls.cdr_layouts.get(data[:2])
        if layout is None or len(data) < len(_CDR) + layout.size:
            return cls()
        return cls(list(layout.unpack_from(data, len(_CDR))))

    @classmethod
    def deserialize_key(cls, data: bytes) -> "Message":
        """Return a blank message, in which cyclonedds wraps the news that the other side has left."""
        return cls()


def _type(name: str, **members: Any) -> Any:
    """Return a type of DDS with members of some types; an array has a type and a length."""
    kinds = {member: array[kind] if isinstance(kind, tuple) else kind for member, kind in members.items()}
    kind = make_idl_struct(name, f"unitree_go.msg.dds_.{name}", kinds, dataclassify=False)
    kind.places, place = {}, 0
    for member, inner in members.items():
        inner, length = inner if isinstance(inner, tuple) else (inner, 0)
        size = getattr(inner, "size", 1)
        kind.places[member] = slice(place, place + size * length) if length else place
        for part, index in getattr(inner, "places", {}).items():
            first = place + getattr(index, "start", index)
            of_legs = slice(first, first + size * len(JOINT_ORDER), size)
            alone = slice(first, place + index.stop) if isinstance(index, slice) else first
            kind.places[f"{member}.{part}"] = of_legs if length else alone
        place += size * max(length, 1)
    kind.size = place
    return kind


# Octets are ``byte``: with uint8, types have other hashes, at which Unitree's version of Cyclone DDS crashes.
_TARGETS = dict.fromkeys(("q", "dq", "tau", "kp", "kd"), float32)
MotorCmd_ = _type("MotorCmd_", mode=byte, **_TARGETS, reserve=(uint32, 3))
BmsCmd_ = _type("BmsCmd_", off=byte, reserve=(byte, 3))
_TRUNK = {"quaternion": (float32, 4), "gyroscope": (float32, 3), "accelerometer": (float32, 3), "rpy": (float32, 3)}
IMUState_ = _type("IMUState_", **_TRUNK, temperature=byte)
_MOTOR = dict.fromkeys(("q", "dq", "ddq", "tau_est", "q_raw", "dq_raw", "ddq_raw"), float32)
MotorState_ = _type("MotorState_", mode=byte, **_MOTOR, temperature=byte, lost=uint32, reserve=(uint32, 2))
"""Unitree names no error flags for Go2; here they are ``reserve[0]``."""
_BATTERY = dict.fromkeys(("version_high", "version_low", "status", "soc"), byte) | {"current": int32, "cycle": uint16}
BmsState_ = _type("BmsState_", **_BATTERY, bq_ntc=(byte, 2), mcu_ntc=(byte, 2), cell_vol=(uint16, 15))
_START = {"head": (byte, 2), "level_flag": byte, "frame_reserve": byte}
_START |= {"sn": (uint32, 2), "version": (uint32, 2), "bandwidth": uint16}
_OF_COMMANDS = {"motor_cmd": (MotorCmd_, SLOTS), "bms_cmd": BmsCmd_, "wireless_remote": (byte, 40), "led": (byte, 12)}
_OF_COMMANDS |= {"fan": (byte, 2), "gpio": byte, "reserve": uint32, "crc": uint32}
LowCmd_: type[Message] = _type("LowCmd_", **_START, **_OF_COMMANDS)
"""Command of a robot, on the topic rt/lowcmd.

Unitree's programs leave ``reserve`` 0; ours number their messages there, from 1.
"""
_OF_STATES = {"imu_state": IMUState_, "motor_state": (MotorState_, SLOTS), "bms_state": BmsState_}
_OF_STATES |= {"foot_force": (int16, 4), "foot_force_est": (int16, 4), "tick": uint32, "wireless_remote": (byte, 40)}
_OF_STATES |= {"bit_flag": byte, "adc_reel": float32, "temperature_ntc1": byte, "temperature_ntc2": byte}
_OF_STATES |= {"power_v": float32, "power_a": float32, "fan_frequency": (uint16, 4), "reserve": uint32, "crc": uint32}
LowState_: type[Message] = _type("LowState_", **_START, **_OF_STATES)
"""State of a robot, on the topic rt/lowstate."""

_CDR = b"\0\1\0\0"
"""How DDS's form begins: little endian."""
_ORDERS = {_CDR[:2]: "<", b"\0\0": ">"}
_IDLE = [SERVO, NO_POSITION, NO_VELOCITY, *[0] * 6]  # command of a drive that gives no torque
_LAYOUTS = {
    LowCmd_: "4B4IH2x" + "B3x5f3I" * SLOTS + "4B55Bx2I",
    LowState_: "4B4IH2x" + "13fB3x" + "B3x7fB3x3I" * SLOTS + "4BiH4B15H8hI41B3xf2B2x2f4H2I",
}
_STATES = [0] * IMUState_.size + [SERVO, *[0] * (MotorState_.size - 1)] * SLOTS
_PARTS: dict[Any, list[Any]] = {LowCmd_: _IDLE * SLOTS, LowState_: _STATES}
for _kind, _layout in _LAYOUTS.items():
    for _name in ("__init__", "__getitem__", "__setitem__", "serialize", "deserialize", "deserialize_key"):
        setattr(_kind, _name, vars(Message)[_name])  # cyclonedds would take a base class for a part of the message
    _unpadded = _layout.replace("H2xB3x", "HBx").replace("B3xB3x", "BB2x")
    _kind.c_layout = struct.Struct("<" + _layout)
    _kind.cdr_layouts = {start: struct.Struct(order + _unpadded) for start, order in _ORDERS.items()}
    _known = [*HEAD, LOW_LEVEL, *[0] * 6, *_PARTS[_kind]]
    _kind.blank = _known + [0] * (_kind.size - len(_known))
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def packed(message: Message) -> bytes:
    """Return a message as the C structure of Unitree's SDK, over which the CRC runs."""
    return message.c_layout.pack(*message.numbers)


def crc(structure: bytes) -> int:
    """Return the CRC of a packed message: CRC-32/MPEG-2 of its words, without the last, most significant bytes first.

    zlib's CRC is the same but for the order of bits: of each byte that goes in, and of the 32 that come out inverted.
    """
    words = np.frombuffer(structure, "<u4", len(structure) // 4 - 1).byteswap().tobytes()
    value = zlib.crc32(words.translate(_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(value.to_bytes(4, "little").translate(_REVERSED), "big")


def _finite(name: str, values: ArrayLike, length: int = len(JOINT_ORDER)) -> np.ndarray:
    """Return values as the wire has them, float32; raises MessageError if they are of another number or not finite."""
    with np.errstate(over="ignore"):  # what is too large becomes infinite
        rounded = np.asarray(values, np.float32)
    if rounded.shape != (length,):
        raise MessageError(f"{name} has the shape {rounded.shape}, not ({length},)")
    if not np.isfinite(rounded).all():
        raise MessageError(f"{name} is not finite")
    return rounded


def _check(message: Message, motors: str) -> None:
    """Raise MessageError unless CRC, head and the modes of the legs' ``motors`` are right."""
    if message["crc"] != crc(packed(message)):
        raise CrcError("wrong CRC")
    head = tuple(message["head"])
    if head == UNSET and isinstance(message, LowState_):
        return
    if head != HEAD:
        raise MessageError(f"the head is {bytes(head).hex()}, not {bytes(HEAD).hex()}: another protocol")
    modes = zip(JOINT_ORDER, message[f"{motors}.mode"], strict=True)
    if wrong := [f"{joint} {mode}" for joint, mode in modes if mode != SERVO]:
        raise MessageError(f"motors are not in mode {SERVO}: {', '.join(wrong)}")


def encode_command(command: MotorCommand, number: int) -> Message:
    """Return the message of a command of the joints in JOINT_ORDER, in float32, with a number below 2 ** 32.

    Raises MessageError if a value is not finite, or there are not twelve.
    """
    message = LowCmd_()
    message["reserve"] = number
    for name in COMMANDED:
        message[f"motor_cmd.{name}"] = _finite(name, getattr(command, name)).tolist()
    message["crc"] = crc(packed(message))
    return message


def decode_command(message: Message) -> MotorCommand:
    """Return the command of a message, float32; raises MessageError, or CrcError, if it is not to be obeyed."""
    _check(message, "motor_cmd")
    if message["level_flag"] != LOW_LEVEL:
        raise MessageError(f"the level flag is {message['level_flag']:#x}, not {LOW_LEVEL:#x}: not for the motors")
    return MotorCommand(**{name: _finite(name, message[f"motor_cmd.{name}"]) for name in COMMANDED})


def encode_state(state: RobotState) -> Message:
    """Return the message of a state of the joints in JOINT_ORDER, in float32, temperatures in whole degrees, 0 to 255.

    Raises MessageError if a number is not finite, or there are not as many as RobotState says.
    """
    message = LowState_()
    message["tick"] = state.tick * STATE_PERIOD % 2**32
    message["version"], message["sn"] = state.identity.reshape(2, 2).tolist()
    message["imu_state.quaternion"] = _finite("quaternion", state.quaternion, 4).tolist()
    message["imu_state.gyroscope"] = _finite("angular_velocity", state.angular_velocity, 3).tolist()
    columns = {member: _finite(name, getattr(state, name)) for name, member in MEASURED.items()}
    columns["temperature"] = np.clip(np.rint(columns["temperature"]), 0, 255).astype(np.uint8)
    _finite("errors", state.errors)
    columns["reserve"] = np.asarray(state.errors, np.uint32)
    for member, column in columns.items():
        message[f"motor_state.{member}"] = column.tolist()
    message["crc"] = crc(packed(message))
    return message


def decode_state(message: Message) -> RobotState:
    """Return the state of a message, float32; raises MessageError, or CrcError, if it is not to be believed."""
    _check(message, "motor_state")
    return RobotState(
        tick=message["tick"] // STATE_PERIOD,
        quaternion=_finite("quaternion", message["imu_state.quaternion"], 4),
        angular_velocity=_finite("angular_velocity", message["imu_state.gyroscope"], 3),
        errors=np.array(message["motor_state.reserve"], np.uint32),
        identity=np.array([*message["version"], *message["sn"]]),
        **{name: _finite(name, message[f"motor_state.{member}"]) for name, member in MEASURED.items()},
    )
