"""A1 and Go1 through a stand-in for unitree_legged_sdk's Python module, which is in no package index."""

import sys
from collections import deque
from types import ModuleType, SimpleNamespace

import mujoco
import numpy as np
import pytest
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque import resource_path
from legged_torque.runtime.controller import Controller, Mode
from legged_torque.runtime.interface import JOINT_ORDER, MotorCommand, Received
from legged_torque.runtime.legged_sdk import LeggedSdkRobot
from legged_torque.runtime.sim_robot import SimRobot


class Udp:
    """The SDK's UDP, at whose other end is a simulated A1, which tells its state once per command; states queue up."""

    def __init__(self, *place):
        assert place == (0xFF, 8080, "192.168.123.10", 8007)
        self.robot = SimRobot(resource_path("resources/robots/a1/a1.xml"), JOINT_ORDER, 500.0)
        self.InitCmdData = lambda command: setattr(command, "is_ready", True)
        self.waiting = deque([self.robot.says()[0]])

    def Recv(self):  # noqa: N802
        self.said = self.waiting.popleft() if self.waiting else self.said

    def GetRecv(self, state):  # noqa: N802
        said = self.said
        imu = SimpleNamespace(quaternion=said.quaternion, gyroscope=said.angular_velocity)
        state.tick, state.imu, state.motorState = said.tick * 2, imu, [SimpleNamespace() for _ in range(20)]
        rows = zip(said.joint_positions, said.joint_velocities, said.joint_torques, said.temperatures, strict=True)
        for motor, row, error in zip(state.motorState, rows, said.errors, strict=False):
            (motor.q, motor.dq, motor.tauEst, motor.temperature), motor.mode = row, 8 if error else 10

    def SetSend(self, command):  # noqa: N802
        assert command.is_ready and command.power and {motor.mode for motor in command.motorCmd[:12]} == {10}
        rows = [(each.tau, each.q, each.dq, each.Kp, each.Kd) for each in command.motorCmd[:12]]
        self.sent = MotorCommand(*np.array(rows, float).T)

    def Send(self):  # noqa: N802
        self.robot.step(Received(self.sent))
        self.waiting.extend(filter(None, [self.robot.says()[0]]))


@pytest.fixture
def sdk(monkeypatch):
    """The module, with the names of its documents."""
    sdk = ModuleType("robot_interface")
    sdk.UDP, sdk.LeggedType, sdk.LowState = Udp, SimpleNamespace(A1="A1", Go1="Go1"), lambda: SimpleNamespace(tick=0)
    sdk.LowCmd = lambda: SimpleNamespace(motorCmd=[SimpleNamespace(mode=0) for _ in range(20)])
    protect = lambda command, state, power: setattr(command, "power", power)  # noqa: E731
    sdk.Safety = lambda kind: SimpleNamespace(PowerProtect=protect, kind=kind)
    monkeypatch.setitem(sys.modules, "robot_interface", sdk)
    return sdk


def test_an_a1_stands_up(policy, sdk):
    """From lying, by the controller's commands; an overheated motor stops it, without a target."""
    robot = LeggedSdkRobot("a1", power=3)
    controller, simulated = Controller(policy, robot.joint_order, 500.0), robot._udp.robot
    for tick in range(1710):
        robot.send(controller.step(robot.receive(), tick / 500.0))
        if tick == 5:
            assert controller.request(Mode.STAND) == ""
        if tick == 1705:
            assert controller.mode == Mode.STAND and simulated.data.qpos[2] > 0.25 and simulated.excess <= 1e-6
            simulated.faults.error = [JOINT_ORDER[4]]
    assert controller.mode == Mode.DAMPING and f"{JOINT_ORDER[4]} has 0x1 as error flag" in controller.reason
    assert robot._command.power == 3 and robot._safety.kind == "A1"
    sent = robot._udp.sent
    assert set(sent.q) == {2.146e9} and not sent.kp.any() and not sent.dq.any() and sent.kd.all()


@pytest.mark.parametrize("name", ["a1", "go1"])
def test_torque_limits(sdk, name):
    """They are those of the bundled models."""
    model = mujoco.MjModel.from_xml_path(str(resource_path(f"resources/robots/{name}/{name}.xml")))
    known = zip(JOINT_ORDER, LeggedSdkRobot(name, power=1).torque_limits, strict=True)
    assert all(model.actuator(joint.removesuffix("_joint")).forcerange[1] == most for joint, most in known)


def test_torques_alone_silence_and_mistakes(exported, sdk, tmp_path, monkeypatch):
    """Without gains, positions and velocities are Unitree's numbers for none; what cannot be is told."""
    robot, zeros = LeggedSdkRobot("go1", power=1), np.zeros(12)
    robot.send(MotorCommand(zeros + 1.5, zeros, zeros, zeros, zeros))
    sent = robot._udp.sent
    assert (set(sent.tau), set(sent.q), set(sent.dq)) == ({1.5}, {2.146e9}, {16000.0})
    for ticks in ([4], [], [68, 78]):  # of those that wait, the newest; at most 32 at a time
        for expected in ticks:
            assert robot.receive().newest.tick == expected
        assert robot.receive().newest is None
        robot._udp.waiting += [robot._udp.robot.says()[0] for _ in range(0 if ticks else 37)]
    with pytest.raises(ValueError, match="not finite"):
        robot.send(MotorCommand(zeros, zeros, zeros, zeros, zeros + np.nan))
    assert "unknown robot of unitree_legged_sdk 'go2'" in error_of(LeggedSdkRobot, "go2", 1)
    words = ["deploy.py", str(exported), "--interface=sdk"]
    assert run_here(*words, "--seconds=0.2", root=tmp_path)[0] == 0
    monkeypatch.setitem(sys.modules, "robot_interface", None)
    assert_told_in_one_line(run_here(*words, root=tmp_path), "need robot_interface of unitree_legged_sdk")
