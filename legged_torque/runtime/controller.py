"""What a robot does: nothing, damping, standing up, or a policy; any fault ends in damping."""

import threading
from enum import Enum

import numpy as np

from legged_torque.deploy.description import holds_gains, refuse_laws
from legged_torque.deploy.policy import Policy, State
from legged_torque.runtime.brakes import Brakes, Joints, fault, limited, mistake
from legged_torque.runtime.interface import MotorCommand, PolicyStep, Received, RobotState
from legged_torque.utils.errors import UserError, refuse, unknown_name

MOST_COMMANDS = 500.0  # a second, unless more are asked for
OPERATOR = "stopped by the operator"
FORGIVEN = 0.4  # time constant with which the time that late ticks have cost is forgiven [s]; 95% of the rate will do


def default_rate(of_policy: float) -> float:
    """Return the commands per second for so many actions: their largest multiple up to 500, or as many."""
    return of_policy * max(1.0, (MOST_COMMANDS + 1e-6) // of_policy)


class Mode(Enum):
    """What the robot does."""

    PASSIVE = "passive"  # no torque at all
    DAMPING = "damping"  # drives slow the joints down
    STAND = "stand"  # the joints move to the nominal pose, and stay there
    POLICY = "policy"


class Controller:
    """Makes the command of each tick from what the robot has said; knows neither clock nor wire.

    The operator may call :meth:`request` from another thread.

    Attributes:
        mode: What the robot does.
        reason: Why it was stopped, until it stands up again; empty if it was not.
        joints: Limits of the robot's joints, in its own order.
        state: The newest state; None before the first.
        velocity_command: v_x, v_y [m/s] and yaw rate [rad/s] for the policy. Shape: (3,).
        sent: The last command.
        policy_step: What the policy has seen and done in this tick; None if it was not asked.
        period: Time between two ticks [s].
    """

    def __init__(self, policy: Policy, joint_order: list[str], rate: float, brakes: Brakes | None = None) -> None:
        """Prepare to drive a robot with joints in an order of its own, ``rate`` ticks a second, by default brakes.

        A UserError if robot and policy have different joints, or ``rate`` is no multiple of the policy's.
        """
        self.policy, self.brakes, self.period = policy, brakes or Brakes(), 1.0 / rate
        of_policy = policy.description["timing"]["control_frequency"]
        self._ticks_per_action = round(rate / of_policy)
        if abs(rate - self._ticks_per_action * of_policy) > 1e-6 * rate:
            raise UserError(f"--rate must be a multiple of the policy's {of_policy:g} Hz, not {rate:g}")
        self._find_joints(joint_order)
        self.mode, self.reason = Mode.DAMPING, ""
        self.state: RobotState | None = None
        self.velocity_command = np.zeros(3)
        self._since, self._state_time, self._now, self._on_time, self._behind = 0.0, -np.inf, 0.0, 0.0, 0.0
        self._damaged = self._missed = 0  # messages, and deadlines in a row
        self._problems: list[str] = []  # of the last look
        self._actions, self._tick, self._from = np.zeros(0, np.float32), 0, self._nominal_pose
        self.sent, self._lock = self._gentle(0.0), threading.Lock()
        self.policy_step: PolicyStep | None = None

    def _find_joints(self, joint_order: list[str]) -> None:
        """Put the limits of the policy's joints into the robot's order; a UserError if it needs what is not there."""
        policy, joints = self.policy, self.policy.description["joints"]
        missing = [name for name in policy.joint_order if name not in joint_order]
        refuse([str(unknown_name("joint of the policy on the robot", name, joint_order)) for name in missing])
        others = [name for name in joint_order if name not in policy.joint_order]
        refuse([f"the policy does not know the robot's joint '{name}'" for name in others])
        if not all("range" in joints[name] and joints[name].get("max_velocity", 0.0) > 0.0 for name in joint_order):
            raise UserError("policy.yaml lacks ranges of joints, or speeds (asset.max_dof_vel): export the policy anew")
        self._order = np.array([policy.joint_order.index(name) for name in joint_order])  # of the policy's vectors
        ranges = np.array([joints[name]["range"] for name in joint_order], float).T
        speeds = np.array([joints[name]["max_velocity"] for name in joint_order], float)
        self.joints = Joints(joint_order, policy.torque_limits[:, self._order].astype(float), ranges, speeds)
        self._nominal_pose = policy.nominal_pose[self._order].astype(float)
        if policy.supplied or policy.scan:
            missing = [*policy.supplied, *(["height_scan"] if policy.scan else [])]
            raise UserError(f"the policy observes {', '.join(missing)}, which this robot does not measure")
        terms = [term["name"] for term in policy.description["actions"]["terms"]]
        if not {*terms} <= {"position_residual", "torque"}:
            raise UserError(f"a robot's drives know position_residual and torque, not the terms {', '.join(terms)}")
        refuse_laws(policy.description)
        if holds_gains(policy.description):
            raise UserError("drives do not hold torques of position_residual: train with control.refresh_torques true")

    # ---- the operator ------------------------------------------------------------------------------------------------

    def request(self, mode: Mode) -> str:
        """Change what the robot does, and return why that is refused; empty if it is done.

        Damping and passivity are never refused. After a fault the robot must stand before it walks.
        """
        with self._lock:
            checks = {Mode.STAND: self._fault, Mode.POLICY: self._not_standing}
            if mode in checks:
                if problem := checks[mode]():
                    return problem
                self._enter(mode)
                self.reason = ""
            else:
                self.stop(OPERATOR)  # does not replace the reason of an earlier stop
                self._enter(mode)
                self.sent = self._at_rest()  # the command of this tick may not have been sent yet
        return ""

    def _not_standing(self) -> str:
        """Return why a policy must not take over."""
        if self.state is None or self.mode != Mode.STAND or self._now - self._since < self.brakes.stand_up:
            return f"the policy takes over once the robot stands, {self.brakes.stand_up:g} s after it was told to"
        off, allowed = np.abs(self.state.joint_positions - self._nominal_pose), self.brakes.max_pose_error
        worst = f"{self.joints.names[off.argmax()]} is {off.max():.2f} rad from the nominal pose"
        return f"{worst}, at most {allowed:g} are allowed" if off.max() > allowed else ""

    def stop(self, reason: str) -> None:
        """End in damping for a reason."""
        if self.mode in (Mode.STAND, Mode.POLICY):
            self._enter(Mode.DAMPING)
            self.reason = reason

    def _enter(self, mode: Mode) -> None:
        """Begin with a mode."""
        self.mode, self._since, self._tick, self._behind = mode, self._now, 0, 0.0
        if self.state is not None:
            self._from = self.state.joint_positions.copy()
        if mode == Mode.POLICY:
            self.policy.reset()

    # ---- a tick ------------------------------------------------------------------------------------------------------

    def step(self, received: Received, now: float, missed: bool = False) -> MotorCommand:
        """Return the command of a tick at a time [s], of what was received since the last; ``missed``: it is late."""
        with self._lock:
            self.policy_step = None
            try:
                self.sent = self._step(received, now, missed)
            except Exception as error:  # whatever it is, the robot must not be left without a command
                self.stop(str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}")
                self.sent = self._gentle(self.brakes.damping)
            return self.sent

    def command_at(self, now: float) -> MotorCommand:
        """Return the command of the tick to send at a time [s]: damping if it is too late by then."""
        with self._lock:
            missed = self._missed + (now - self._now > self.period)
            if self.mode in (Mode.STAND, Mode.POLICY) and (problem := self._lateness(now, missed)):
                self.stop(problem)
                self.sent = self._gentle(self.brakes.damping)
            return self.sent

    def _step(self, received: Received, now: float, missed: bool) -> MotorCommand:
        """Do what :meth:`step` says, if all goes well."""
        moves, late = self.mode in (Mode.STAND, Mode.POLICY), now - self._now - self.period
        self._behind = max(0.0, (1.0 - self.period / FORGIVEN) * self._behind + late) if moves else 0.0
        self._now, self._on_time = now, self._on_time if missed else now
        self._missed = self._missed + 1 if missed else 0
        if isinstance(received.newest, RobotState):
            self.state, self._state_time, self._damaged = received.newest, now, 0
        self._damaged += received.wrong_crc
        self._problems = received.problems
        if problem := self._fault():
            self.stop(problem)
        if self.mode in (Mode.STAND, Mode.POLICY) and self.state is not None:
            return self._moving(self.state)
        return self._at_rest()

    def _moving(self, state: RobotState) -> MotorCommand:
        """Return the command of a robot that stands or walks, within its limits; damping if it cannot be meant."""
        command = self._standing(self._now - self._since) if self.mode == Mode.STAND else self._walking(state)
        if problem := mistake(command, state, self.joints):
            self.stop(problem)
            return self._gentle(self.brakes.damping)
        if self.mode == Mode.POLICY:
            command = self._taking_over(command)
        before = np.clip(self.sent.torques(state.joint_positions, state.joint_velocities), *self.joints.torque_limits)
        return limited(command, state, before, self.brakes.torque_rate * self.period, self.joints)

    def _fault(self) -> str:
        """Return why the robot must not move."""
        if self.state is None:
            silent = "all messages are damaged" if self._damaged else "the robot has not said anything yet"
            return next(iter(self._problems), silent)
        if problem := self._lateness(self._now, self._missed):
            return problem
        seen = Received(None, self._damaged, problems=self._problems)
        return fault(self.state, self._now - self._state_time, seen, self.joints, self.brakes)

    def _lateness(self, now: float, missed: int) -> str:
        """Return why it is too late for a command at a time [s], after so many missed deadlines in a row."""
        late, allowed = now - self._on_time, self.brakes.max_slow if missed > 1 else self.brakes.max_missed
        if late > allowed + 1e-6:
            return f"all deadlines of {1e3 * late:.0f} ms were missed"
        lost, allowed = self._behind, self.brakes.max_behind
        if lost > allowed:
            limit = f"at most {1e3 * allowed:.0f} are allowed"
            return f"late ticks have cost {1e3 * lost:.1f} ms, {limit}: this computer is too slow or too busy"
        return ""

    def _at_rest(self) -> MotorCommand:
        """Return the command of a robot that neither stands nor walks."""
        return self._gentle(0.0 if self.mode == Mode.PASSIVE else self.brakes.damping)

    def _gentle(self, damping: float) -> MotorCommand:
        """Return a command without targets, whose damping is within the limits at the last known speeds."""
        zeros = np.zeros(len(self.joints.names))
        speeds = np.abs(self.state.joint_velocities) if self.state is not None else zeros
        most = np.abs(self.joints.torque_limits).min(axis=0) / np.maximum(np.nan_to_num(speeds), 1e-6)
        return MotorCommand(zeros, zeros, zeros, zeros, np.minimum(damping, most))

    def _standing(self, seconds: float) -> MotorCommand:
        """Return the command on the way from where the joints were to the nominal pose, smooth at both ends."""
        share = np.clip(seconds / self.brakes.stand_up, 0.0, 1.0)
        target = self._from + share * share * (3.0 - 2.0 * share) * (self._nominal_pose - self._from)
        zeros, (kp, kd) = np.zeros_like(target), self.brakes.stand_gains
        return MotorCommand(zeros, target, zeros, zeros + kp, zeros + kd)

    def _walking(self, state: RobotState) -> MotorCommand:
        """Return the policy's command."""
        policy, to_policy = self.policy, np.argsort(self._order)
        if self._tick % self._ticks_per_action == 0:
            joints = state.joint_positions[to_policy], state.joint_velocities[to_policy]
            seen = State(state.angular_velocity, *joints, quaternion=state.quaternion)
            obs = policy.observation(seen, self.velocity_command)
            self._actions = policy.act(obs)
            self.policy_step = PolicyStep(obs, self._actions, is_first=self._tick == 0)
        self._tick += 1
        tau, q, kp, kd = (part[self._order] for part in policy.drive_targets(self._actions))
        return MotorCommand(tau, q, np.zeros(len(q)), kp, kd)

    def _taking_over(self, command: MotorCommand) -> MotorCommand:
        """Return a mixture of the policy's command, which takes over bit by bit at first, and of standing."""
        share = min(1.0, (self._now - self._since) / self.brakes.ramp)
        standing = self._standing(np.inf)
        parts = zip(vars(standing).values(), vars(command).values(), strict=True)
        return MotorCommand(*((1.0 - share) * old + share * new for old, new in parts))
