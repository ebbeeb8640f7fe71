"""A1 and Go1 through ``robot_interface``, the Python module of Unitree's unitree_legged_sdk. Never run on hardware.

Unitree builds the module for the Go1 (SDK 3.8). For the A1, one has to be built against SDK 3.3.3 with the same names.
"""

import numpy as np

from legged_torque.runtime.interface import JOINT_ORDER, NO_POSITION, NO_VELOCITY, MotorCommand, Received, RobotState
from legged_torque.utils.errors import UserError, check_names

KINDS = {"a1": "A1", "go1": "Go1"}  # names of the SDK
TORQUES = {"a1": [33.5, 33.5, 33.5], "go1": [23.7, 23.7, 35.55]}  # largest of hip, thigh and calf [N m]
LOW_LEVEL, LOCAL_PORT, ROBOT = 0xFF, 8080, ("192.168.123.10", 8007)
SERVO, OVERHEATED = 0x0A, 0x08  # modes of a motor
AT_ONCE = 32  # messages of a look, at most


class LeggedSdkRobot:
    """A robot as the program sees it, a ``Transport``. The SDK drops damaged messages, so they are only missing."""

    joint_order = JOINT_ORDER

    def __init__(self, robot: str, power: int) -> None:
        """Connect to a robot by its name, "a1" or "go1"; ``power`` of 1 to 10 has the SDK limit it to 10 to 100%.

        A UserError if it is another robot, or the module is not installed.
        """
        check_names("robot of unitree_legged_sdk", [robot], KINDS)
        try:
            import robot_interface as sdk
        except ImportError as error:
            raise UserError(f"A1 and Go1 need robot_interface of unitree_legged_sdk in PYTHONPATH ({error})") from None
        self.torque_limits = TORQUES[robot] * 4
        self._udp = sdk.UDP(LOW_LEVEL, LOCAL_PORT, *ROBOT)
        self._safety, self._power = sdk.Safety(getattr(sdk.LeggedType, KINDS[robot])), power
        self._command, self._state, self._tick = sdk.LowCmd(), sdk.LowState(), 0
        self._udp.InitCmdData(self._command)

    def receive(self) -> Received:
        """Return the newest state, if there is one whose ``tick`` is new: the SDK hands out one after the other."""
        before = self._tick
        for _ in range(AT_ONCE):
            self._udp.Recv()
            self._udp.GetRecv(self._state)
            if self._state.tick == self._tick:
                break
            self._tick = self._state.tick
        if self._tick == before:
            return Received()
        imu, motors = self._state.imu, self._state.motorState[: len(JOINT_ORDER)]
        rows = [(each.q, each.dq, each.tauEst, each.temperature, each.mode == OVERHEATED) for each in motors]
        q, dq, torques, temperatures, errors = np.array(rows, float).T
        trunk = np.array(imu.quaternion), np.array(imu.gyroscope)
        return Received(RobotState(self._tick, *trunk, q, dq, torques, temperatures, errors.astype(int)))

    def send(self, command: MotorCommand) -> None:
        """Tell the drives; without gains, position and velocity are Unitree's numbers for none."""
        q, dq = np.where(command.kp, command.q, NO_POSITION), np.where(command.kd, command.dq, NO_VELOCITY)
        rows = np.stack([q, dq, command.tau, command.kp, command.kd], axis=1)
        if not np.isfinite(rows).all():
            raise ValueError("a command is not finite")
        for motor, row in zip(self._command.motorCmd, rows.tolist(), strict=False):
            motor.mode = SERVO
            motor.q, motor.dq, motor.tau, motor.Kp, motor.Kd = row
        self._safety.PowerProtect(self._command, self._state, self._power)
        self._udp.SetSend(self._command)
        self._udp.Send()

    def close(self) -> None:
        """Leave; the robot is in damping."""
