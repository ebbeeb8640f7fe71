"""Those who tell a robot what to do: keys in a terminal, datagrams, a gamepad; and what they see of it."""

import io
import json
import os
import select
import socket
import struct
import time

import pytest
from rich.console import Console
from support.scripts import ROOT, in_a_terminal
from support.settings import error_of
from support.simulated import standing_at_once

from legged_torque.runtime import operator
from legged_torque.runtime.controller import Mode
from legged_torque.runtime.loop import RealTimeLoop
from legged_torque.runtime.view import View

STILL = [0.0, 0.0, 0.0]


@pytest.fixture
def robot(policy):
    """A simulated robot in damping, whose policy was trained for 1 m/s and 1 rad/s at most."""
    return standing_at_once(policy)


def does(robot):
    """Its mode after some ticks, and its command."""
    return robot.run(10), robot.controller.velocity_command.round(4).tolist()


def test_a_policy_for_one_command(robot):
    """Its robot may be told to stand, and nothing else."""
    ranges = {"lin_vel_x": [0.5, 0.5], "lin_vel_y": [0.0, 0.0], "ang_vel_yaw": [-0.2, -0.2]}
    policy, description = robot.controller.policy, robot.controller.policy.description
    policy.description = description | {"commands": description["commands"] | ranges}
    try:
        asks = operator.Operator(robot.controller)
    finally:
        policy.description = description
    for command, given in ((STILL, STILL), ([1.0, 1.0, 1.0], [0.5, 0.0, 0.0]), ([-1.0, 0.0, -1.0], [0.0, 0.0, -0.2])):
        asks.move(command)
        assert robot.controller.velocity_command.tolist() == given
    asks.begin_with(STILL)
    assert "lin_vel_x of --command must be from 0 to 0.5" in error_of(asks.begin_with, [0.6, 0.0, 0.0])


def free_port():
    """A port that nobody listens on."""
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        return str(other.getsockname()[1])


@pytest.fixture
def datagrams(robot, monkeypatch):
    """An operator on a free port, and what sends it something and has it look."""
    monkeypatch.setattr(operator, "SILENCE", 0.2)
    with operator.Datagrams(robot.controller, free_port()) as receiver, socket.socket(type=socket.SOCK_DGRAM) as sender:

        def send(*contents):
            for content in contents:
                data = content if isinstance(content, bytes) else json.dumps(content).encode()
                sender.sendto(data, receiver._socket.getsockname())
            time.sleep(0.02)
            receiver.look()
            return does(robot)

        yield receiver, send


BAD = [b"", b"{", b"\xff\xfe", b"[]", b"3", b'{"forward": NaN}', b'{"forward": 1e400}', b'{"forward": true}', b"null"]
BAD += [b'{"forwards": 1}', b'{"mode": "walk"}', b'{"mode": ["stand"]}', b'{"turn": "1"}', b" " * 300 + b"{}"]


def test_commands_of_datagrams(robot, datagrams):
    """They stay within the trained ranges; bad ones are counted; after silence all is 0, once."""
    receiver, send = datagrams
    assert send({"forward": 0.5, "sideways": -0.25, "turn": 9}) == (Mode.DAMPING, [0.5, -0.25, 1.0])
    assert send({"turn": -0.5}, {"forward": 0.3}, *BAD) == (Mode.DAMPING, [0.3, 0.0, 0.0])
    assert receiver.note == f"{len(BAD)} bad datagrams"
    time.sleep(0.25)
    assert send(*BAD) == (Mode.DAMPING, STILL)  # no signs of life
    robot.controller.velocity_command[:] = 0.7  # of another operator
    receiver.look()
    assert does(robot)[1] == [0.7, 0.7, 0.7]
    host, port = receiver._socket.getsockname()
    assert host == "127.0.0.1"
    for address in (str(port), "0", "65536", "here", "192.0.2.1:9000", "nowhere.invalid:9000"):
        assert f"not {address}" in error_of(operator.Datagrams, robot.controller, address)


def test_modes_of_datagrams(robot, datagrams):
    """They are asked for once: a stream does not raise a robot again after a fault. Damping is always obeyed."""
    receiver, send = datagrams
    for asked, mode in (("policy", "damping"), ("stand", "stand"), ("policy", "policy"), ("stand", "stand")):
        assert send({"mode": asked}, {"mode": asked})[0] == Mode(mode)
        assert receiver.note.startswith("no policy now") == (mode == "damping")
    robot.robot.faults.silent = True
    assert does(robot)[0] == Mode.DAMPING
    robot.robot.faults.silent = False
    does(robot)
    assert send({"mode": "stand"}, {"mode": "stand"})[0] == Mode.DAMPING
    assert send({"mode": "damping"}, {"mode": "stand"})[0] == Mode.STAND
    assert send({"mode": "damping"})[0] == Mode.DAMPING
    robot.controller.request(Mode.STAND)  # by another operator
    assert send({"mode": "damping"})[0] == Mode.DAMPING


def test_gamepad(robot, tmp_path):
    """Events as the kernel tells them: sticks with a dead zone, buttons; a device that is gone damps."""
    file = tmp_path / "js0"
    os.mkfifo(file)
    device = file.open("r+b", 0)
    device.write(struct.pack("<IhBB", 1, 30000, 0x82, 1))  # how things were at first
    with operator.Gamepad(robot.controller, str(file)) as gamepad:
        for events, expected in (
            ([], (Mode.DAMPING, STILL)),
            ([(1, 0x81, 0)], (Mode.DAMPING, STILL)),
            ([(-32767, 2, 1), (3000, 2, 0), (18022, 2, 3), (1, 2, 2), (1, 1, 0)], (Mode.STAND, [1.0, 0.0, -0.5])),
            ([(0, 0x82, 1), (0, 2, 3), (0, 1, 0), (1, 1, 2)], (Mode.POLICY, STILL)),  # the first after events were lost
            ([(1, 1, 1), (0, 1, 1)], (Mode.DAMPING, STILL)),
            ([(1, 1, 0), (-32767, 2, 1)], (Mode.STAND, [1.0, 0.0, 0.0])),
            ([(0, 0x81, 1), (1, 0x81, 2)], (Mode.STAND, [1.0, 0.0, 0.0])),  # pressed while events were lost
            ([(1, 0x81, 1)], (Mode.DAMPING, [1.0, 0.0, 0.0])),
        ):
            device.write(b"".join(struct.pack("<IhBB", 1234, *event) for event in events))
            gamepad.look()
            assert does(robot) == expected
        device.close()
        gamepad.look()
        gamepad.look()
        assert does(robot) == (Mode.DAMPING, STILL) and gamepad.note == "the gamepad is gone"


@pytest.mark.parametrize("reached", [Mode.STAND, Mode.POLICY])
def test_unattended(robot, reached):
    """A robot that another operator has damped stays so; why the policy waits is noted."""
    unattended, notes = operator.Unattended(robot.controller), set()
    robot.controller.brakes.stand_up = 0.03  # seconds, of which each tick takes 0.02
    while does(robot)[0] != reached:
        unattended.look()
        notes.add(unattended.note)
    why = "no policy now: the policy takes over once the robot stands, 0.03 s after it was told to"
    assert (why in notes) == (reached == Mode.POLICY)
    unattended.look()
    for mode in (Mode.DAMPING, Mode.STAND):
        robot.controller.request(mode)
        for _ in range(2):
            unattended.look()
            assert does(robot)[0] == mode and not unattended.note


def test_keys(robot, monkeypatch):
    """As a terminal sends them, also several at once."""
    master, slave = os.openpty()
    with open(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        with operator.Keyboard(robot.controller) as keyboard:
            os.set_blocking(slave, False)
            os.write(master, b"\x13?")  # Ctrl-S, which would hold up all that is written
            assert select.select([slave], [], [], 10.0)[0] and os.write(slave, b"x") == 1
            keyboard.look()
            for keys, *expected in (
                (b"p\x1b[A\x1b[A,", Mode.DAMPING, [0.2, 0.1, 0.0]),
                (b"s.\x1b[B\x1b[D", Mode.STAND, [0.1, 0.0, 0.1]),
                (b"p" + b"\x1b[C" * 20, Mode.POLICY, [0.1, 0.0, -1.0]),
                (b"0 ", Mode.DAMPING, STILL),
                (b"s\x1a", Mode.DAMPING, STILL),  # Ctrl-Z and Ctrl-\, which would halt or end the program
                (b"s", Mode.STAND, STILL),
                (b"\x1c", Mode.DAMPING, STILL),
                (b",s", Mode.STAND, [0.0, 0.1, 0.0]),
                (b"\x1bx\x1b[20~\x1b[20;5~\x1bOd\x1b\x1b[20~\x1bq", Mode.STAND, [0.0, 0.1, 0.0]),  # Alt+x, F9, ...
                (b"\x1b[20", Mode.STAND, [0.0, 0.1, 0.0]),  # cut off
                (b"\x1b \x1bs", Mode.DAMPING, [0.0, 0.1, 0.0]),  # a stop counts, whatever else is hit
                (b"0\x1bs\x1b\x1b[A\x1b", Mode.DAMPING, STILL),
                (b"s", Mode.STAND, STILL),
                (b"x?q", Mode.PASSIVE, STILL),
            ):
                os.write(master, keys)
                keyboard.look()
                assert [*does(robot)] == expected and keyboard.has_ended == keys.endswith(b"?q")
    os.close(master)


def test_view(robot, exported):
    """A line and a table of joints against their limits, also of numbers that are none; deploy.py draws it."""
    unattended = operator.Unattended(robot.controller)
    view = View(robot, RealTimeLoop(500.0, print), [unattended])
    for mode in (Mode.STAND, Mode.POLICY, Mode.POLICY):
        unattended.look()
        assert does(robot)[0] == mode
    robot.robot.faults.hot, unattended.note = ["RR_calf_joint"], "something to know"
    for robot.robot.faults.not_finite in (False, True):
        does(robot)
        Console(file=(text := io.StringIO()), width=300).print(view.table())
        line, _, *rows = text.getvalue().splitlines()
        by_joint = {row.split()[0]: row for row in rows}
        assert set(by_joint) == set(robot.controller.joints.names) and " 120 " in by_joint["RR_calf_joint"]
        assert line.startswith("damping (RR_calf_joint has 120 deg C, too hot)") and "something to know" in line
    words = [str(ROOT / "scripts" / "deploy.py"), str(exported), "--interface=sim", "--seconds=1"]
    words += [f"--udp={free_port()}"]
    code = f"import runpy, sys; sys.argv = {words}; runpy.run_path(sys.argv[0], run_name='__main__')"
    status, output = in_a_terminal(code, columns=120)
    assert status == 0 and "of the limit" in output and "FR_hip_joint" in output
