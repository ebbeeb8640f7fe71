"""Unitree's messages for Go2: bytes, CRC, round trips, and what is refused."""

import dataclasses
import json
import re
import struct
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the extra: pip install 'legged_torque[robot]'")

from cyclonedds.idl import Endianness
from cyclonedds.idl.types import array
from make_unitree_messages import FILE, messages, summary, type_id

from legged_torque.runtime import unitree_go2 as go2
from legged_torque.runtime.interface import MotorCommand, RobotState
from legged_torque.runtime.motion_switcher import Request_, Response_

ORACLE = json.loads(FILE.read_text("utf-8"))
"""What Unitree's own package makes of random messages, see make_unitree_messages.py."""
RANGES = {"q": (-3.0, 3.0), "dq": (-30.0, 30.0), "tau": (-45.0, 45.0), "kp": (0.0, 100.0), "kd": (0.0, 5.0)}


@pytest.fixture
def rng():
    """Random numbers, the same in each run."""
    return np.random.default_rng(3)


@pytest.fixture
def command(rng):
    """A command of plausible numbers."""
    return MotorCommand(**{name: rng.uniform(low, high, 12).astype(np.float32) for name, (low, high) in RANGES.items()})


@pytest.fixture
def state(rng):
    """A state of plausible numbers, temperatures in whole degrees."""
    return RobotState(
        7,
        rng.normal(size=4).astype(np.float32),
        rng.normal(size=3).astype(np.float32),
        *rng.normal(size=(3, 12)).astype(np.float32),
        temperatures=rng.integers(20, 90, 12).astype(np.float32),
        errors=rng.integers(0, 2**32, 12, dtype=np.uint32),
    )


@pytest.mark.parametrize("kind", [go2.LowCmd_, go2.LowState_])
def test_messages_of_the_sdk(kind):
    """10 000 random messages have the bytes and CRCs that Unitree's own package gives them, and keep them when read."""
    groups = re.findall(r"(\d*)([a-wyzA-Z])", kind.c_layout.format)
    codes = "".join(code * int(count or 1) for count, code in groups)
    sent = (kind(numbers).serialize() for numbers in messages(codes))
    assert summary((data, go2.crc(go2.packed(kind.deserialize(data)))) for data in sent) == ORACLE[kind.__name__]


@pytest.mark.parametrize("kind", [go2.LowCmd_, go2.LowState_, Request_, Response_])
def test_types_of_the_sdk(kind):
    """DDS takes a type for the same as Unitree's: otherwise the two sides do not connect, or the older one crashes."""
    assert type_id(kind) == ORACLE["types"][kind.__name__]


def test_bytes_of_a_command(command):
    """The packed message is the SDK's structure; unused motors are told to do nothing."""
    message = go2.encode_command(command, 9)
    told = zip(command.q, command.dq, command.tau, command.kp, command.kd, strict=True)
    motors = [(1, *numbers, 0, 0, 0) for numbers in told]
    motors += [(1, 2.146e9, 16000.0, 0.0, 0.0, 0.0, 0, 0, 0)] * 8
    numbers = [number for motor in motors for number in motor]
    numbers = [0xFE, 0xEF, 0xFF, *[0] * 6, *numbers, *[0] * 59, 9, message["crc"]]
    expected = struct.pack("<4B4IH2x" + "B3x5f3I" * 20 + "4B" + "55Bx2I", *numbers)
    assert go2.packed(message) == expected and len(expected) == 812
    assert message["crc"] == go2.crc(expected)


def test_bytes_of_a_state(state):
    """The packed message is the SDK's structure; its clock counts 2 ms per state."""
    message = go2.encode_state(state)
    imu = [*state.quaternion, *state.angular_velocity, *[0.0] * 6, 0]
    measured = zip(state.joint_positions, state.joint_velocities, state.joint_torques, strict=True)
    motors = [(1, q, dq, 0.0, tau, 0.0, 0.0, 0.0) for q, dq, tau in measured] + [(1, *[0.0] * 7)] * 8
    ends = [(int(t), 0, int(e), 0) for t, e in zip(state.temperatures, state.errors, strict=True)] + [(0, 0, 0, 0)] * 8
    moving = [number for motor, end in zip(motors, ends, strict=True) for number in (*motor, *end)]
    battery_and_feet = [0] * (4 + 2 + 4 + 15 + 8)
    rest = [14, *[0] * 41, 0.0, 0, 0, 0.0, 0.0, *[0] * 4, 0, message["crc"]]
    layout = "<4B4IH2x" + "13fb3x" + "B3x7fb3x3I" * 20 + "4BiH4b15H" + "8hI41B3xf2b2x2f4h2I"
    expected = struct.pack(layout, 0xFE, 0xEF, 0xFF, *[0] * 6, *imu, *moving, *battery_and_feet, *rest)
    assert go2.packed(message) == expected and len(expected) == 1180
    assert message["crc"] == go2.crc(expected)


def as_objects(kind, numbers):
    """The next numbers as a message of a type, or as a part of one, in the form that cyclonedds serializes itself."""
    if not hasattr(kind, "places"):
        return next(numbers)
    members = {}
    for name, hint in kind.__annotations__.items():
        several = get_args(hint)[-1] if get_args(hint) else None
        if isinstance(several, array):
            members[name] = [as_objects(several.subtype, numbers) for _ in range(several.length)]
        else:
            members[name] = as_objects(hint, numbers)
    return SimpleNamespace(**members)


@pytest.mark.parametrize("kind", [go2.LowCmd_, go2.LowState_])
def test_wire_form(kind, rng):
    """Messages of random numbers have the bytes that cyclonedds itself makes, and come back; big-endian ones, too."""
    for _ in range(50):
        numbers = kind.c_layout.unpack(rng.integers(0, 128, kind.c_layout.size, dtype=np.uint8).tobytes())
        data, objects = kind(list(numbers)).serialize(), as_objects(kind, iter(numbers))
        assert data == kind.__idl__.serialize(objects, use_version_2=False)
        for form in (data, kind.__idl__.serialize(objects, endianness=Endianness.Big, use_version_2=False)):
            assert tuple(kind.deserialize(form).numbers) == numbers
        for damaged in (data[:-1], b"\0\3" + data[2:], b""):
            with pytest.raises(go2.CrcError):
                (go2.decode_state if kind is go2.LowState_ else go2.decode_command)(kind.deserialize(damaged))


def test_names_of_numbers(rng):
    """Names lead to the numbers that they have in the SDK's messages; of motors, to those of the legs."""
    numbers = list(range(go2.LowState_.size))
    message, objects = go2.LowState_(numbers), as_objects(go2.LowState_, iter(numbers))
    assert message["tick"] == objects.tick and message["crc"] == objects.crc == numbers[-1]
    assert message["imu_state.gyroscope"] == objects.imu_state.gyroscope
    assert message["motor_state.q"] == [motor.q for motor in objects.motor_state[:12]]
    assert message["motor_state.reserve"] == [motor.reserve[0] for motor in objects.motor_state[:12]]


def assert_equal(one, other):
    """Two commands or states are the same to the bit."""
    for name, value in vars(one).items():
        assert np.array_equal(value, getattr(other, name)), name


def test_round_trips(command, state):
    """Over the wire and back, float32 numbers stay as they are; the order is that of Unitree's legs and of exports."""
    sent = go2.LowCmd_.deserialize(go2.encode_command(command, 1).serialize())
    assert_equal(command, go2.decode_command(sent))
    told = go2.LowState_.deserialize(go2.encode_state(state).serialize())
    assert_equal(state, go2.decode_state(told))
    assert go2.JOINT_ORDER[:4] == ["FR_hip_joint", "FR_thigh_joint", "FR_calf_joint", "FL_hip_joint"]
    assert [name[:2] for name in go2.JOINT_ORDER[::3]] == ["FR", "FL", "RR", "RL"]


def test_temperatures_are_whole_degrees(state):
    """Degrees are rounded and held within a byte."""
    state.temperatures = np.array([20.4, 20.6, -5.0, 300.0, *[30.0] * 8])
    assert go2.decode_state(go2.encode_state(state)).temperatures[:5].tolist() == [20, 21, 0, 255, 30]


def sealed(message):
    """A message with the CRC of what it says."""
    message["crc"] = go2.crc(go2.packed(message))
    return message


def change(message, name, value, place=None):
    """Change a number of a message, or the one of a motor."""
    values = message[name]
    if place is not None:
        values[place] = value
    message[name] = value if place is None else values


@pytest.mark.parametrize("bit", [0, 300, 811 * 8 - 40])
def test_a_damaged_bit_is_seen(command, bit):
    """A bit that flips on its way is a wrong CRC."""
    data = bytearray(go2.encode_command(command, 1).serialize())
    data[4 + bit // 8] ^= 1 << bit % 8
    with pytest.raises(go2.CrcError):
        go2.decode_command(go2.LowCmd_.deserialize(bytes(data)))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (("head", [1, 2]), "0102"),
        (("level_flag", 0xEE), "0xee"),
        (("motor_cmd.mode", 0x0A, 4), "FL_thigh_joint 10"),
        (("motor_cmd.tau", np.nan, 11), "tau"),
        (("motor_cmd.kp", np.inf, 0), "kp"),
    ],
)
def test_wrong_commands_are_refused(command, changed, said):
    """A command of another kind, or without a number, is refused by name though its CRC is right."""
    message = go2.encode_command(command, 1)
    change(message, *changed)
    with pytest.raises(go2.MessageError, match=said) as error:
        go2.decode_command(sealed(message))
    assert not isinstance(error.value, go2.CrcError)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (("head", [0xFE, 0xEE]), "feee"),
        (("motor_state.mode", 0, 3), "FL_hip_joint 0"),
        (("motor_state.q", np.nan, 3), "joint_positions"),
        (("imu_state.quaternion", [1.0, 0.0, np.inf, 0.0]), "quaternion"),
    ],
)
def test_wrong_states_are_refused(state, changed, said):
    """So is a state."""
    message = go2.encode_state(state)
    change(message, *changed)
    with pytest.raises(go2.MessageError, match=said):
        go2.decode_state(sealed(message))


def test_states_of_unitree_mujoco(state):
    """Its states have neither head nor modes, and are read."""
    message = go2.encode_state(state)
    message["head"], message["motor_state.mode"] = [0, 0], [0] * 12
    assert_equal(state, go2.decode_state(sealed(message)))


@pytest.mark.parametrize("value", [np.full(12, np.nan), np.full(12, 1e39), np.zeros(11), np.zeros((12, 1))])
def test_what_the_wire_cannot_carry_is_not_sent(command, state, value):
    """Numbers that are not finite as float32, or not one per joint, raise an error."""
    with pytest.raises(go2.MessageError, match="kd"):
        go2.encode_command(dataclasses.replace(command, kd=value), 1)
    with pytest.raises(go2.MessageError, match="joint_torques"):
        go2.encode_state(dataclasses.replace(state, joint_torques=value))
    with pytest.raises(go2.MessageError, match="errors"):
        go2.encode_state(dataclasses.replace(state, errors=value))
