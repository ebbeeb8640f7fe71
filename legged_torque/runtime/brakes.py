"""When to stop a robot, and the limits within which torques stay."""

from dataclasses import dataclass

import numpy as np

from legged_torque.runtime.interface import MotorCommand, Received, RobotState

LARGEST_ASKED = 10.0  # times its limit: a torque beyond this is a mistake, not a wish
MAX_LENGTH_ERROR = 0.1  # of a quaternion; 0 is what an IMU says that has not started


@dataclass
class Brakes:
    """Numbers that end a walk, and those of the damping in which it ends."""

    max_age: float = 0.013  # of the newest state [s]
    max_tilt: float = 1.0  # of the trunk from upright [rad]
    max_overrun: float = 0.1  # of a joint beyond its range [rad]
    max_temperature: float = 90.0  # of a motor [deg C]
    max_damaged: int = 3  # messages with a wrong checksum since the last whole one
    max_missed: float = 0.014  # seconds of one late tick, as when the program is halted
    max_slow: float = 0.008  # seconds in which every deadline of several ticks was missed
    max_behind: float = 0.02  # seconds that late ticks have cost in all, of which some is forgiven
    max_pose_error: float = 0.5  # of a joint from the nominal pose when a policy takes over [rad]
    torque_rate: float = 2000.0  # most by which a torque changes [N m/s]
    ramp: float = 0.5  # seconds in which a policy takes over from standing
    stand_up: float = 3.0  # seconds from any pose to the nominal one
    stand_gains: tuple[float, float] = (60.0, 5.0)  # of the drives meanwhile [N m/rad, N m s/rad]
    damping: float = 3.0  # of the drives when all else has ended [N m s/rad]


@dataclass
class Joints:
    """What joints can do. Shapes: (joints,), of ranges (2, joints)."""

    names: list[str]
    torque_limits: np.ndarray  # lowest and highest [N m]
    position_limits: np.ndarray  # [rad]
    velocity_limits: np.ndarray  # [rad/s]


def fault(state: RobotState, age: float, received: Received, joints: Joints, brakes: Brakes) -> str:
    """Return why a robot must not walk on, in words that name the part; empty if it may.

    The state has been known for ``age`` [s]; of damaged messages, ``received`` has those since the last whole one.
    """
    if age > brakes.max_age:
        return f"no state for {1e3 * age:.0f} ms, at most {1e3 * brakes.max_age:.0f} are allowed"
    if received.wrong_crc >= brakes.max_damaged:
        return f"{received.wrong_crc} messages with a wrong checksum"
    if received.problems:
        return received.problems[0]
    for name in ("quaternion", "angular_velocity", "joint_positions", "joint_velocities", "temperatures", "errors"):
        if not np.isfinite(getattr(state, name)).all():
            return f"a measurement is not finite, of {name}"
    if abs((length := float(np.linalg.norm(state.quaternion))) - 1.0) > MAX_LENGTH_ERROR:
        return f"the trunk's orientation is a quaternion of length {length:.2g}, not 1"
    if (tilt := tilt_of(state.quaternion)) > brakes.max_tilt:
        return f"the trunk is tilted by {tilt:.2f} rad, at most {brakes.max_tilt:g} are allowed"
    low, high = joints.position_limits
    beyond = np.maximum(state.joint_positions - high, low - state.joint_positions) - brakes.max_overrun
    speeds = np.abs(state.joint_velocities) - joints.velocity_limits
    hot = state.temperatures - brakes.max_temperature
    for excess, what, values in (
        (beyond, "rad, beyond its range", state.joint_positions),
        (speeds, "rad/s, too fast", state.joint_velocities),
        (hot, "deg C, too hot", state.temperatures),
        (np.abs(state.errors), "as error flag", state.errors),
    ):
        worst = int(np.argmax(excess))
        if excess[worst] > 0:
            number = f"{int(values[worst]):#x}" if values is state.errors else f"{values[worst]:.4g}"
            return f"{joints.names[worst]} has {number} {what}"
    return ""


def tilt_of(quaternion: np.ndarray) -> float:
    """Return the angle between the trunk's up and the world's [rad], from (w, x, y, z)."""
    _, x, y, _ = np.asarray(quaternion, float) / max(float(np.linalg.norm(quaternion)), 1e-9)
    return float(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))


def limited(
    command: MotorCommand, state: RobotState, before: np.ndarray, largest_change: float, joints: Joints
) -> MotorCommand:
    """Return a command whose torques in a state are within the limits, and near those before. Shape: (joints,) [N m].

    The feed-forward torque takes the difference, so that gains stay those of the policy: should no command follow,
    torques fall as the joints move.
    """
    asked = command.torques(state.joint_positions, state.joint_velocities)
    allowed = np.clip(np.clip(asked, *joints.torque_limits), before - largest_change, before + largest_change)
    return MotorCommand(command.tau + allowed - asked, command.q, command.dq, command.kp, command.kd)


def mistake(command: MotorCommand, state: RobotState, joints: Joints) -> str:
    """Return what no policy can mean: torques that are no numbers, or far beyond the limits; empty if there is none."""
    asked = command.torques(state.joint_positions, state.joint_velocities)
    if not np.isfinite(asked).all():
        return "the policy's torques are not finite"
    excess = np.abs(asked) / np.abs(joints.torque_limits).max(axis=0)
    worst = int(np.argmax(excess))
    return f"the policy asks {joints.names[worst]} for {asked[worst]:.4g} N m" if excess[worst] > LARGEST_ASKED else ""
