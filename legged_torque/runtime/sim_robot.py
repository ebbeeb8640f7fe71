"""The other side: a robot in plain MuJoCo with drives, a watchdog and faults, that speaks a robot's messages."""

import math
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_torque.deploy.ground import place_ground
from legged_torque.deploy.robot import joints_and_motors
from legged_torque.motors.model_config import MotorsCfg
from legged_torque.motors.twin import MotorTwin
from legged_torque.runtime.interface import MotorCommand, Received, RobotState
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import colliding_pairs, hang_up, loading, set_joints, torque_per_control, torque_range

WATCHDOG = 0.015  # seconds without a command after which the drives damp by themselves
DAMPING = 3.0  # of the drives then [N m s/rad]
STEP = 1e-3  # longest of the physics, at which the drives close their loops [s]
FAR = 10.0  # farther than any part is from the ground [m]
FOLDED = {"hip": 0.0, "thigh": 1.25, "calf": -2.65}  # angles of a robot that lies on its belly [rad]


@dataclass
class Faults:
    """What is wrong with the robot; nothing at first."""

    lost: float = 0.0  # share of its messages that do not arrive
    delay: float = 0.0  # by which they are late [s]
    damaged: float = 0.0  # share of its messages with a wrong checksum
    dead: list[str] = field(default_factory=list)  # joints without torque
    hot: list[str] = field(default_factory=list)  # joints whose motors say 120 deg C
    error: list[str] = field(default_factory=list)  # joints whose motors raise an error flag
    not_finite: bool = False  # whether a joint's position is NaN
    silent: bool = False  # whether it says nothing at all
    push: float = 0.0  # sudden change of the trunk's velocity in a random level direction, once [m/s]


class SimRobot:
    """A robot of an MJCF, whose drives do what Unitree's do, at the rate of the physics.

    A drive asks its motor for tau + kp (q - position) + kd (dq - velocity). Without commands it damps.

    Attributes:
        joint_order: Names of the joints.
        model: MuJoCo's model.
        data: Its state.
        faults: What is wrong.
        watchdog_ticks: Messages that were sent while the watchdog damped, after the first command.
        excess: Largest torque beyond a limit that a command has asked for in any physics step [N m].
        is_damping: Whether the drives only damp now.
    """

    def __init__(
        self,
        xml: Path,
        joint_order: list[str],
        rate: float,
        motors: MotorsCfg | None = None,
        latency: float = 0.0,
        hangs: bool = False,
    ) -> None:
        """Put the robot of a file on a plane, lying; it sends ``rate`` messages a second.

        Its motors are ideal unless their settings are given; gains of a drive come with commands, which arrive
        ``latency`` [s] late. If it ``hangs``, it is held by its trunk and touches nothing. A UserError if the file is
        unreadable or lacks a motor, a joint is no hip, thigh or calf, or a motor is a network.
        """
        if unknown := [name for name in joint_order if not any(part in name for part in FOLDED)]:
            raise UserError(f"a simulated robot has {', '.join(FOLDED)} joints, as A1 and Go2, and no '{unknown[0]}'")
        self._steps = max(math.ceil(1.0 / (rate * STEP) - 1e-9), 1)
        with loading(xml):
            spec = mujoco.MjSpec.from_file(str(xml))
            place_ground(spec, {}, [])
            spec.option.timestep = 1.0 / (rate * self._steps)
            self.model = spec.compile()
        self.data, self.joint_order = mujoco.MjData(self.model), joint_order
        joints, self._motors = joints_and_motors(self.model, joint_order)
        self._qpos, self._dofs = self.model.jnt_qposadr[joints], self.model.jnt_dofadr[joints]
        self._torque_per_control = np.array([torque_per_control(self.model, motor) for motor in self._motors])
        self.limits = np.array([torque_range(self.model, motor) for motor in self._motors]).T
        self._drives = MotorTwin(self._description(motors))
        set_joints(self.model, motors.of_joints(joint_order) if motors else {})
        if hangs:
            hang_up(self.model)
        self._lift = -hangs * self.model.body_mass[1] * self.model.opt.gravity  # [N]
        self._latency, self._on_their_way = latency, deque[tuple[float, MotorCommand]]()
        self._rng, self.faults = np.random.default_rng(0), Faults()
        self.watchdog_ticks, self.excess, self.is_damping = 0, 0.0, True
        self._command: MotorCommand | None = None
        self._age, self._tick = np.inf, 0
        self._late: deque[tuple[float, RobotState]] = deque()
        self._applied = np.zeros(len(joint_order))
        self.lie_down()

    def lie_down(self, joint_positions: np.ndarray | None = None, quaternion: np.ndarray | None = None) -> None:
        """Lay the robot on its belly with folded legs, or put it on the ground as it was measured.

        Joint positions [rad] have the shape (joints,); the quaternion of the trunk is (w, x, y, z).
        """
        mujoco.mj_resetData(self.model, self.data)
        self._on_their_way.clear()  # their times are of the clock before
        low, high = self.model.jnt_range[[self.model.joint(name).id for name in self.joint_order]].T
        folded = [next(angle for part, angle in FOLDED.items() if part in name) for name in self.joint_order]
        self.data.qpos[self._qpos] = np.clip(folded, low, high) if joint_positions is None else joint_positions
        if quaternion is not None:
            self.data.qpos[3:7] = quaternion
        mujoco.mj_kinematics(self.model, self.data)
        pairs = [pair for pair in colliding_pairs(self.model).tolist() if 0 in self.model.geom_bodyid[pair]]
        gaps = [mujoco.mj_geomDistance(self.model, self.data, *pair, FAR, None) for pair in pairs]
        self.data.qpos[2] -= min(gaps, default=0.0)  # a robot that hangs touches nothing
        self.data.xfrc_applied[1, :3] = self._lift
        mujoco.mj_forward(self.model, self.data)

    def step(self, received: Received) -> None:
        """Move on for the time between two messages, under the newest command."""
        self._age += self._steps * self.model.opt.timestep
        if self.faults.push:
            angle = self._rng.uniform(-math.pi, math.pi)
            self.data.qvel[:2] += self.faults.push * np.array([math.cos(angle), math.sin(angle)])
            self.faults.push = 0.0
        if isinstance(received.newest, MotorCommand):
            self._on_their_way.append((self.data.time + self._latency, received.newest))
        zeros = np.zeros(len(self.joint_order))
        damping, had_command = MotorCommand(zeros, zeros, zeros, zeros, zeros + DAMPING), self._command is not None
        is_dead, was_damping = np.isin(self.joint_order, self.faults.dead), False
        self._drives.begin()
        for _ in range(self._steps):
            while self._on_their_way and self._on_their_way[0][0] <= self.data.time + 1e-9:
                self._command, self._age = self._on_their_way.popleft()[1], 0.0
            command = self._command if self._age <= WATCHDOG else None
            self.is_damping = command is None
            was_damping |= self.is_damping
            pos, vel = self.data.qpos[self._qpos], self.data.qvel[self._dofs]
            asked = (command or damping).torques(*self._drives.measured(pos, vel))
            if command is not None:
                self.excess = max(self.excess, float(np.maximum(asked - self.limits[1], self.limits[0] - asked).max()))
            self._applied = np.where(is_dead, 0.0, self._drives.apply(asked, pos, vel))
            self.data.ctrl[self._motors] = self._applied / self._torque_per_control
            mujoco.mj_step(self.model, self.data)
        self.watchdog_ticks += had_command and was_damping

    def _description(self, motors: MotorsCfg | None) -> dict[str, Any]:
        """Return what the motors read of a ``policy.yaml``, at the rate of the physics."""
        names, zeros = self.joint_order, dict.fromkeys(self.joint_order, 0.0)
        limits = {name: [float(low), float(high)] for name, low, high in zip(names, *self.limits, strict=True)}
        timing = {"decimation": self._steps, "physics_frequency": 1.0 / self.model.opt.timestep}
        gains = {"stiffness": zeros, "damping": zeros}
        described = {"joint_order": names, "timing": timing, "torque_limits": limits, "nominal_pose": zeros}
        links = motors.describe().items() if motors else ()
        own = {name: link for name, link in links if link.get("model") != "drive"}
        if any(link.get("model") == "network" for link in own.values()):
            raise UserError("a motor network needs fixed gains; those of a simulated robot come with commands")
        return {**described, "gains": gains, "motors": own}

    def says(self) -> tuple[RobotState | None, bool]:
        """Return the next message, or none if it is lost or late, and whether it is to be damaged on its way."""
        faults, names, qpos, qvel = self.faults, np.array(self.joint_order), self.data.qpos, self.data.qvel
        self._tick += 1
        pos, vel = self._drives.measured(qpos[self._qpos], qvel[self._dofs])
        pos[:1] += np.nan if faults.not_finite else 0.0
        hot, errors = np.isin(names, faults.hot), np.isin(names, faults.error)
        motors = (self._applied.copy(), np.where(hot, 120.0, 40.0), errors.astype(int))
        state = RobotState(self._tick, qpos[3:7].copy(), qvel[3:6].copy(), pos, vel, *motors)
        self._late.append((self.data.time + faults.delay, state))
        if faults.silent or self._rng.random() < faults.lost:
            self._late.pop()
        arrived = None
        while self._late and self._late[0][0] <= self.data.time + 1e-9:
            arrived = self._late.popleft()[1]
        return arrived, bool(self._rng.random() < faults.damaged)


class InProcess:
    """A :class:`SimRobot` as a transport in the same process: it moves on with each command, without a wire or a time.

    Attributes:
        robot: The robot.
        joint_order: Names of its joints.
        torque_limits: Of its motors [N m].
    """

    def __init__(self, robot: SimRobot) -> None:
        """Take the robot."""
        self.robot, self.joint_order = robot, robot.joint_order
        self.torque_limits = np.abs(robot.limits).max(axis=0).tolist()
        self._tick = 0

    def receive(self) -> Received:
        """Return what the robot says."""
        state, is_damaged = self.robot.says()
        if state is None or is_damaged:
            return Received(wrong_crc=int(is_damaged and state is not None))
        lost, self._tick = max(state.tick - self._tick - 1, 0), state.tick
        return Received(state, lost=lost)

    def send(self, command: MotorCommand) -> None:
        """Let the robot move on under a command."""
        self.robot.step(Received(command))

    def close(self) -> None:
        """Do nothing."""
