"""The state of a robot and commands of its motors, whatever carries them."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

JOINT_ORDER = [f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")]
"""Of Unitree's A1, Go1 and Go2."""
NO_POSITION, NO_VELOCITY = 2.146e9, 16000.0  # as q and dq of Unitree's drives: nothing is held, nothing damped


@dataclass
class RobotState:
    """Measurements of a robot; joints in the robot's own order."""

    tick: int  # number of the message; the next one is 1 more
    quaternion: np.ndarray  # the trunk's orientation (w, x, y, z); (4,)
    angular_velocity: np.ndarray  # of the trunk, in its own frame [rad/s]; (3,)
    joint_positions: np.ndarray  # [rad]; (joints,)
    joint_velocities: np.ndarray  # [rad/s]; (joints,)
    joint_torques: np.ndarray  # as the drives estimate them [N m]; (joints,)
    temperatures: np.ndarray  # of the motors [deg C], 0 where there is no sensor; (joints,)
    errors: np.ndarray  # error flags of the motors, 0 is none; (joints,)
    identity: np.ndarray = field(default_factory=lambda: np.zeros(4, int))  # version of firmware, serial number; (4,)


@dataclass
class MotorCommand:
    """Targets and gains of each drive: torque = tau + kp (q - position) + kd (dq - velocity). Shapes: (joints,)."""

    tau: np.ndarray  # [N m]
    q: np.ndarray  # [rad]
    dq: np.ndarray  # [rad/s]
    kp: np.ndarray  # [N m/rad]
    kd: np.ndarray  # [N m s/rad]

    def torques(self, joint_positions: np.ndarray, joint_velocities: np.ndarray) -> np.ndarray:
        """Return the torques [N m] at joint positions [rad] and velocities [rad/s]. Shapes: (joints,)."""
        return self.tau + self.kp * (self.q - joint_positions) + self.kd * (self.dq - joint_velocities)


@dataclass
class Received:
    """Messages of the other side since the last look."""

    newest: RobotState | MotorCommand | None = None  # the last one that was whole; None if none came
    wrong_crc: int = 0  # how many were damaged
    lost: int = 0  # how many are missing by their numbers
    late: int = 0  # how many came after a later one, and were dropped
    problems: list[str] = field(default_factory=list)  # of another kind: mode, version


@dataclass
class PolicyStep:
    """What a policy saw and did."""

    observations: np.ndarray  # (observations,), float32
    actions: np.ndarray  # (actions,), float32
    is_first: bool  # whether the policy has just started


class Transport(Protocol):
    """The robot as the program sees it. A new one is one file: deploy.py --interface FILE.py:CLASS calls its class.

    Attributes:
        joint_order: Names of the joints in the robot's own order.
        torque_limits: What their motors can give at most [N m]; a policy that may ask for more is refused.
    """

    joint_order: list[str]
    torque_limits: list[float]

    def receive(self) -> Received:
        """Return what has come from the robot since the last call; never waits."""

    def send(self, command: MotorCommand) -> None:
        """Send a command to the drives."""

    def close(self) -> None:
        """Leave."""
