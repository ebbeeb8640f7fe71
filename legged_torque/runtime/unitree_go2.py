"""Unitree's messages for Go2 and newer robots: what goes over the wire, and its CRC.

Names, order and sizes of the fields are those of Unitree's SDK (unitree_sdk2_python, ``idl/unitree_go/msg/dds_``), as
DDS connects only sides whose types are the same. Structure and CRC: ``utils/crc.py`` there.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from operator import attrgetter
from typing import Any

import numpy as np
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl.types import array, float32, int16, int32, uint8, uint16, uint32
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


def _zeros(name: str, **members: Any) -> Any:
    """Return a type whose numbers are 0 at first, of types by member; an array's have a type and a length."""
    kinds = {member: array[kind] if isinstance(kind, tuple) else kind for member, kind in members.items()}
    struct = make_idl_struct(name, f"unitree_go.msg.dds_.{name}", kinds, dataclassify=False)
    for member, kind in members.items():
        setattr(struct, member, (0,) * kind[1] if isinstance(kind, tuple) else 0)
    return dataclass(struct)


@dataclass
class MotorCmd_(IdlStruct, typename="unitree_go.msg.dds_.MotorCmd_"):
    """Command of one drive; at first, of no torque."""

    mode: uint8 = SERVO
    q: float32 = NO_POSITION
    dq: float32 = NO_VELOCITY
    tau: float32 = 0.0
    kp: float32 = 0.0
    kd: float32 = 0.0
    reserve: array[uint32, 3] = (0,) * 3


BmsCmd_ = _zeros("BmsCmd_", off=uint8, reserve=(uint8, 3))


@dataclass
class LowCmd_(IdlStruct, typename="unitree_go.msg.dds_.LowCmd_"):
    """Command of a robot, on the topic rt/lowcmd.

    Unitree's programs leave ``reserve`` 0; ours number their messages there, from 1.
    """

    head: array[uint8, 2] = HEAD
    level_flag: uint8 = LOW_LEVEL
    frame_reserve: uint8 = 0
    sn: array[uint32, 2] = (0,) * 2
    version: array[uint32, 2] = (0,) * 2
    bandwidth: uint16 = 0
    motor_cmd: array[MotorCmd_, SLOTS] = field(default_factory=lambda: [MotorCmd_() for _ in range(SLOTS)])
    bms_cmd: BmsCmd_ = field(default_factory=BmsCmd_)
    wireless_remote: array[uint8, 40] = (0,) * 40
    led: array[uint8, 12] = (0,) * 12
    fan: array[uint8, 2] = (0,) * 2
    gpio: uint8 = 0
    reserve: uint32 = 0
    crc: uint32 = 0


_TRUNK = {"quaternion": (float32, 4), "gyroscope": (float32, 3), "accelerometer": (float32, 3), "rpy": (float32, 3)}
IMUState_ = _zeros("IMUState_", **_TRUNK, temperature=uint8)
_MOTOR = dict.fromkeys(("q", "dq", "ddq", "tau_est", "q_raw", "dq_raw", "ddq_raw"), float32)
MotorState_ = _zeros("MotorState_", mode=uint8, **_MOTOR, temperature=uint8, lost=uint32, reserve=(uint32, 2))
"""Unitree names no error flags for Go2; here they are ``reserve[0]``."""
_BATTERY = dict.fromkeys(("version_high", "version_low", "status", "soc"), uint8) | {"current": int32, "cycle": uint16}
BmsState_ = _zeros("BmsState_", **_BATTERY, bq_ntc=(uint8, 2), mcu_ntc=(uint8, 2), cell_vol=(uint16, 15))


@dataclass
class LowState_(IdlStruct, typename="unitree_go.msg.dds_.LowState_"):
    """State of a robot, on the topic rt/lowstate."""

    head: array[uint8, 2] = HEAD
    level_flag: uint8 = LOW_LEVEL
    frame_reserve: uint8 = 0
    sn: array[uint32, 2] = (0,) * 2
    version: array[uint32, 2] = (0,) * 2
    bandwidth: uint16 = 0
    imu_state: IMUState_ = field(default_factory=IMUState_)
    motor_state: array[MotorState_, SLOTS] = field(default_factory=lambda: [MotorState_(SERVO) for _ in range(SLOTS)])
    bms_state: BmsState_ = field(default_factory=BmsState_)
    foot_force: array[int16, 4] = (0,) * 4
    foot_force_est: array[int16, 4] = (0,) * 4
    tick: uint32 = 0
    wireless_remote: array[uint8, 40] = (0,) * 40
    bit_flag: uint8 = 0
    adc_reel: float32 = 0.0
    temperature_ntc1: uint8 = 0
    temperature_ntc2: uint8 = 0
    power_v: float32 = 0.0
    power_a: float32 = 0.0
    fan_frequency: array[uint16, 4] = (0,) * 4
    reserve: uint32 = 0
    crc: uint32 = 0


_FORMATS: dict[type, str] = {
    LowCmd_: "<4B4IH2x" + "B3x5f3I" * SLOTS + "4B55Bx2I",
    LowState_: "<4B4IH2x" + "13fB3x" + "B3x7fB3x3I" * SLOTS + "4BiH4B15H8hI41B3xf2B2x2f4H2I",
}
"""The messages as C structures, little endian: 812 and 1180 bytes, the last four of which are the CRC."""
_LAYOUTS = {kind: struct.Struct(text) for kind, text in _FORMATS.items()}
_UNPADDED = {kind: text.replace("H2xB3x", "HBx").replace("B3xB3x", "BB2x") for kind, text in _FORMATS.items()}
_WIRE = {kind: struct.Struct(text) for kind, text in _UNPADDED.items()}
"""The same in DDS's own form, CDR, which begins with _CDR and has less padding."""
_CDR = b"\0\1\0\0"
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_MEMBERS = {
    kind: attrgetter(*(member.name for member in fields(kind)))
    for kind in (MotorCmd_, BmsCmd_, LowCmd_, IMUState_, MotorState_, BmsState_, LowState_)
}
"""What reads all fields of a message or a part of one, in order."""


def _numbers(part: IdlStruct) -> Iterator[Any]:
    """Yield all numbers of a message or a part of one, in order."""
    for value in _MEMBERS[type(part)](part):
        if isinstance(value, (int, float)):
            yield value
        elif isinstance(value, IdlStruct):
            yield from _numbers(value)
        elif isinstance(value[0], IdlStruct):
            for inner in value:
                yield from _numbers(inner)
        else:
            yield from value


def _filled(blank: Any, numbers: Iterator[Any]) -> Any:
    """Return a message like a blank one, or a part of it, with numbers in order."""
    if isinstance(blank, (int, float)):
        return next(numbers)
    if isinstance(blank, IdlStruct):
        return type(blank)(*[_filled(member, numbers) for member in _MEMBERS[type(blank)](blank)])
    return [_filled(each, numbers) for each in blank]


def _serialize(self: Any, use_version_2: bool | None = None) -> bytes:
    """Do what cyclonedds does in Python, in a fourth of the time."""
    return _CDR + _WIRE[type(self)].pack(*_numbers(self))


def _deserialize(kind: Any, data: bytes) -> Any:
    """Do what cyclonedds does in Python, in a third of the time; or leave other forms of CDR to it."""
    if data[:2] != _CDR[:2] or len(data) < len(_CDR) + _WIRE[kind].size:
        return kind.__idl__.deserialize(data)
    return _filled(kind(), iter(_WIRE[kind].unpack_from(data, len(_CDR))))


for _kind in _WIRE:
    _kind.serialize, _kind.deserialize = _serialize, classmethod(_deserialize)


def packed(message: LowCmd_ | LowState_) -> bytes:
    """Return a message as the C structure of Unitree's SDK, over which the CRC runs."""
    return _LAYOUTS[type(message)].pack(*_numbers(message))


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


def _check(message: LowCmd_ | LowState_, modes: list[int]) -> None:
    """Raise MessageError unless CRC, head and the modes of the legs' motors are right."""
    if message.crc != crc(packed(message)):
        raise CrcError("wrong CRC")
    if tuple(message.head) == UNSET and isinstance(message, LowState_):
        return
    if tuple(message.head) != HEAD:
        raise MessageError(f"the head is {bytes(message.head).hex()}, not {bytes(HEAD).hex()}: another protocol")
    wrong = [f"{joint} {mode}" for joint, mode in zip(JOINT_ORDER, modes, strict=True) if mode != SERVO]
    if wrong:
        raise MessageError(f"motors are not in mode {SERVO}: {', '.join(wrong)}")


def encode_command(command: MotorCommand, number: int) -> LowCmd_:
    """Return the message of a command of the joints in JOINT_ORDER, in float32, with a number below 2 ** 32.

    Raises MessageError if a value is not finite, or there are not twelve.
    """
    message = LowCmd_(reserve=number)
    columns = [_finite(name, getattr(command, name)) for name in COMMANDED]
    for motor, row in zip(message.motor_cmd, np.stack(columns, axis=1).tolist(), strict=False):
        motor.tau, motor.q, motor.dq, motor.kp, motor.kd = row
    message.crc = crc(packed(message))
    return message


def decode_command(message: LowCmd_) -> MotorCommand:
    """Return the command of a message, float32; raises MessageError, or CrcError, if it is not to be obeyed."""
    motors = message.motor_cmd[: len(JOINT_ORDER)]
    _check(message, [motor.mode for motor in motors])
    if message.level_flag != LOW_LEVEL:
        raise MessageError(f"the level flag is {message.level_flag:#x}, not {LOW_LEVEL:#x}: not for the motors")
    return MotorCommand(**{name: _finite(name, [getattr(motor, name) for motor in motors]) for name in COMMANDED})


def encode_state(state: RobotState) -> LowState_:
    """Return the message of a state of the joints in JOINT_ORDER, in float32, temperatures in whole degrees, 0 to 255.

    Raises MessageError if a number is not finite, or there are not as many as RobotState says.
    """
    message = LowState_(tick=state.tick * STATE_PERIOD % 2**32)
    message.imu_state.quaternion = _finite("quaternion", state.quaternion, 4).tolist()
    message.imu_state.gyroscope = _finite("angular_velocity", state.angular_velocity, 3).tolist()
    columns = {member: _finite(name, getattr(state, name)) for name, member in MEASURED.items()}
    columns["temperature"] = np.clip(np.rint(columns["temperature"]), 0, 255).astype(np.uint8)
    for member, column in columns.items():
        for motor, value in zip(message.motor_state, column.tolist(), strict=False):
            setattr(motor, member, value)
    for motor, flags in zip(message.motor_state, np.asarray(state.errors, np.uint32).tolist(), strict=False):
        motor.reserve = (flags, 0)
    message.crc = crc(packed(message))
    return message


def decode_state(message: LowState_) -> RobotState:
    """Return the state of a message, float32; raises MessageError, or CrcError, if it is not to be believed."""
    motors = message.motor_state[: len(JOINT_ORDER)]
    _check(message, [motor.mode for motor in motors])
    columns = {name: [getattr(motor, member) for motor in motors] for name, member in MEASURED.items()}
    return RobotState(
        tick=message.tick // STATE_PERIOD,
        quaternion=_finite("quaternion", message.imu_state.quaternion, 4),
        angular_velocity=_finite("angular_velocity", message.imu_state.gyroscope, 3),
        errors=np.array([motor.reserve[0] for motor in motors], np.uint32),
        **{name: _finite(name, column) for name, column in columns.items()},
    )
