"""Sweeps of all joints of a robot that hangs in the air, in place of a policy, for identify.py."""

import contextlib
import sys

import numpy as np

from legged_torque.deploy.policy import Policy, State
from legged_torque.utils.errors import UserError

FREQUENCIES = (0.1, 10.0)  # [Hz] of a sweep, from first to last, as of PACE
SWEEPS = (0.8, 0.2)  # shares of the time: the second one is for what identify.py holds out
LARGEST = 0.25  # [rad] amplitude
ROOM, SPEED, TORQUE = 0.5, 0.25, 0.5  # most of the room to the next end of a range, and of largest speed and torque
RAMP = 0.5  # [s] at both ends of a sweep
PER_TURN = 10  # commands in a period of the fastest part, at least: with fewer, targets jump
APART = 2.4  # [rad] phase from joint to joint: the golden angle
ANSWER = "it hangs"
CHECKSUM = "chirp"  # that logs have in place of a network's


class Chirp(Policy):
    """A policy without a network, whose actions are sweeps of the joints about the nominal pose.

    It has the gains of another policy, and the brakes act as on that one. Amplitudes fall with the frequency, so that
    speeds and torques of targets stay within shares of the limits.

    Attributes:
        has_ended: Whether both sweeps are over; then the pose is held.
    """

    has_ended = False

    def __init__(self, policy: Policy, rate: float, seconds: float) -> None:
        """Take a policy's robot and gains, for so many ticks a second; a UserError for too few ticks, or no gains."""
        if rate < (least := PER_TURN * FREQUENCIES[1]):
            raise UserError(f"--rate must be at least {least:g} for the {FREQUENCIES[1]:g} Hz of --chirp, not {rate:g}")
        vars(self).update(vars(policy))
        if not (self.stiffness > 0.0).all():
            raise UserError("--chirp needs a policy with a stiffness above 0 of all joints: its sweeps are positions")
        term = {"name": "position_residual", "scale": 1.0, "mixing_weight": 1.0}
        self._action_terms, self.supplied, self.scan = [term], [], None
        timing = policy.description["timing"] | {"control_frequency": rate, "refresh_torques": True}
        network = policy.description["network"] | {"sha256": CHECKSUM}
        self.description = policy.description | {"actions": {"terms": [term]}, "timing": timing, "network": network}
        self._period, self._seconds = 1.0 / rate, seconds
        joints = [policy.description["joints"][name] for name in self.joint_order]
        low, high = np.array([joint.get("range", (-np.inf, np.inf)) for joint in joints]).T
        room = np.minimum(high - self.nominal_pose, self.nominal_pose - low)
        self._amplitude = np.clip(ROOM * room, 0.0, LARGEST)
        self._speed = SPEED * np.array([joint.get("max_velocity", 0.0) for joint in joints])
        self._torque = TORQUE * np.abs(self.torque_limits).min(axis=0)
        self.reset()

    def reset(self) -> None:
        """Begin with the first sweep."""
        self._tick, self.has_ended = 0, False

    def observation(self, state: State, command: np.ndarray) -> np.ndarray:
        """Return nothing, which is all it sees."""
        return np.zeros(0, np.float32)

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Return targets less the nominal pose [rad]. Shape: (joints,)."""
        time, place = self._tick * self._period, np.arange(len(self.joint_order))
        self._tick += 1
        first = SWEEPS[0] * self._seconds
        second = (time - first, self._seconds - first, 1.0 - 2.0 * (place % 2))
        time, length, signs = (time, first, 1.0) if time < first else second
        self.has_ended = time >= length
        start, rise = FREQUENCIES[0], (FREQUENCIES[1] - FREQUENCIES[0]) / length
        phase, speed = 2.0 * np.pi * (start + 0.5 * rise * time) * time, 2.0 * np.pi * (start + rise * time)
        of_torque = self._torque / np.hypot(self.stiffness, speed * self.damping)
        amplitude = np.minimum(np.minimum(self._amplitude, self._speed / speed), of_torque)
        share = np.clip(min(time, length - time) / RAMP, 0.0, 1.0)
        return (signs * share * amplitude * np.sin(phase + APART * place)).astype(np.float32)


def confirm() -> None:
    """Ask the operator whether the robot hangs; a UserError if it does not, or there is nobody to ask."""
    if not sys.stdin.isatty():
        raise UserError("--chirp asks whether the robot hangs, and needs a terminal for that")
    print("All legs will move fast, for as long as --chirp says. Nobody and nothing may be within their reach.")
    answer = ""
    with contextlib.suppress(EOFError):
        answer = input(f"If the robot hangs in the air, held firmly by its trunk, type '{ANSWER}': ")
    if answer.strip() != ANSWER:
        raise UserError("--chirp is only for robots that hang")
