"""An exported policy in plain MuJoCo, one robot after another."""

import dataclasses
import math
from collections import deque
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from legged_torque.deploy.policy import Policy, State
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.motors.config import LatencyCfg
from legged_torque.motors.twin import MotorTwin
from legged_torque.utils.display import Counter
from legged_torque.utils.errors import UserError
from legged_torque.utils.heading import heading
from legged_torque.utils.metrics import NUM_SUMS, Estimate, estimates, ratios, step_sums

PUSH_ADDED = 0.5  # share of pushes that add a velocity, as in training; the others set one


class Simulation:
    """Runs a policy as in evaluation: random initial states and commands, pushes, new episodes.

    On rough ground, all episodes of a run start on one tile, which is drawn. Pushes that set a velocity set
    ``pushes.set_factor`` of ``policy.yaml`` times the draw, as in training. Exports that do not name the factor are
    simulated with 1.0, and a note says so.

    Attributes:
        command: Present v_x, v_y [m/s] and yaw rate [rad/s]. Shape: (3,).
        has_losses: Whether the policy's description has copper losses, so that they are measured.
        notes: Differences from the training, a line each.
    """

    def __init__(
        self,
        policy: Policy,
        robot: MujocoRobot,
        command: tuple[float, float, float] | None = None,
        push_velocity: float = 0.0,
        push_probability: float = 0.0,
    ) -> None:
        """Prepare; :meth:`run` starts an episode. A UserError if the policy needs terms that nobody supplies here.

        Args:
            policy: The policy.
            robot: The robot that it drives.
            command: Fixed v_x, v_y [m/s] and yaw rate [rad/s]; None draws them as in training.
            push_velocity: Largest draw of each axis of a push's velocity, either way [m/s].
            push_probability: Of a push per control step.
        """
        if policy.supplied:
            why = "for which there is no numpy function here; a file of the task's (--task_file) may add it"
            raise UserError(f"plain MuJoCo has no values of {', '.join(policy.supplied)}, {why}")
        self.policy, self.robot = policy, robot
        self._motors = MotorTwin(policy.description)
        self._push_velocity, self._push_probability = push_velocity, push_probability
        description = policy.description
        self._timing, self._start = description["timing"], description["initial_state"]
        self._commands, pushes = dict(description["commands"]), description.get("pushes", {})
        if command:
            self._commands.pop("heading", None)  # the yaw rate is given
        self._max_steps = math.ceil(description["episode"]["length"] * self._timing["control_frequency"] - 1e-6)
        ranges = [self._commands[name] for name in ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")]
        self._command_range = np.array([command, command] if command else np.transpose(ranges), float)
        self._heights = deque[np.ndarray](maxlen=1 + (policy.scan["delay"] if policy.scan else 0))
        self._actions, self._measurements = (Latency(description, name) for name in ("actions", "measurements"))
        self._push_set_factor, self.notes = pushes.get("set_factor", 1.0), list[str]()
        if push_probability and not pushes:
            lacks = "policy.yaml does not name pushes.set_factor"
            self.notes.append(f"pushes: {lacks}, so 1.0 is taken; trainings have 1.1 by default")
        if others := description["episode"].get("not_simulated"):
            self.notes.append(f"episodes of the training are different, by {', '.join(others)}")
        losses = description.get("copper_loss", {})
        self._copper_loss = np.array([losses.get(name, 0.0) for name in policy.joint_order])
        self.has_losses = bool(self._copper_loss.any())
        self.command, self._power = np.zeros(3), np.zeros(3)
        self._last_torques: np.ndarray | None = None  # of the episode
        self._peak_force = 0.0
        self._steps = 0

    def run(self, num_steps: int, seed: Any, on_step: Callable[[], None] = lambda: None) -> np.ndarray:
        """Run one robot for some control steps and return sums of metrics, see ``step_sums``. Shape: (NUM_SUMS,).

        A UserError if they are not finite.

        Args:
            num_steps: Control steps.
            seed: For ``np.random.default_rng``.
            on_step: Called after every control step, e.g. to record it.
        """
        self._rng = np.random.default_rng(seed)
        self._origin = self.robot.origins[self._rng.integers(len(self.robot.origins))]
        self._new_episode()
        self._follow_heading()
        sums = np.zeros(NUM_SUMS)
        with np.errstate(over="ignore", invalid="ignore"):  # reported below, in one line
            for _ in range(num_steps):
                command = self.command.copy()
                self._control_step()
                sums += self._finish_step(command)
                on_step()
        if not np.isfinite(sums).all():
            raise UserError("the simulation has diverged, its metrics are no numbers: check policy.yaml and the MJCF")
        return sums

    def _control_step(self) -> None:
        """Observe, act, and apply torques in all physics steps of a control step; keep their power and change."""
        policy, robot = self.policy, self.robot
        is_late = self._measurements.is_needed
        state = dataclasses.replace(self._measurements.received(self._now)) if is_late else self._measured()
        self._heights.append(robot.position[2] - robot.ground_heights(policy.scan_places(robot.position, robot.quat)))
        state.heights = self._heights[0]  # the oldest, of this episode
        self._actions.send(self._now, policy.act(policy.observation(state, self.command)))
        self._motors.begin()
        self._power[:] = 0.0
        for i in range(self._timing["decimation"]):
            pos, vel = robot.joint_positions(), robot.joint_velocities()
            if i == 0 or self._timing["refresh_torques"]:
                actions = self._actions.received(self._now)
                wanted = policy.wanted_torques(actions, *self._motors.measured(pos, vel))
            robot.step(self._motors.apply(wanted, pos, vel))
            applied = self._motors.before_friction(robot.applied_torques())
            power = np.abs(applied * robot.joint_velocities()).sum(), applied**2 @ self._copper_loss
            change = 0.0 if self._last_torques is None else np.abs(applied - self._last_torques).mean()
            self._power += *power, change
            self._peak_force = max(self._peak_force, robot.contact_force())
            self._last_torques = applied
            self._now += 1
            if is_late:
                self._measurements.send(self._now, self._measured())
        self._power[:2] /= self._timing["decimation"]
        self._steps += 1

    def _finish_step(self, command: np.ndarray) -> np.ndarray:
        """End the step in the order of training, and return what it adds to the metrics."""
        robot = self.robot
        fell = robot.has_fallen()
        ended = fell or self._steps >= self._max_steps
        force, peak = robot.contact_force(), self._peak_force
        if ended:
            self._new_episode()
        elif self._rng.random() < self._commands["resampling_probability"]:
            self._draw_command()
        if self._rng.random() < self._push_probability:
            self._push()
        self._follow_heading()
        velocity = robot.planar_velocity()
        numbers = (np.linalg.norm(velocity[:2]), force, *self._power, robot.height(), fell, ended, peak)
        arrays = [command[None], velocity[None], *(np.array([number]) for number in numbers)]
        return step_sums(np, *arrays, tracked=2 if "heading" in self._commands else 3)[:, 0]

    def _push(self) -> None:
        """Push the trunk: half of the pushes add to its velocity, the others set it."""
        velocity, drawn = self.robot.velocity, self._drawn([-self._push_velocity, self._push_velocity], 3)
        velocity[:] = velocity + drawn if self._rng.random() < PUSH_ADDED else self._push_set_factor * drawn

    def _new_episode(self) -> None:
        """Draw an initial state and a command, and reset the policy."""
        start, num_joints = self._start, len(self.policy.joint_order)
        angles = [self._drawn(start[name]) for name in ("roll", "pitch", "yaw")]
        pose = self.policy.nominal_pose * self._drawn(start["joint_position_scale"], num_joints)
        sizes = {"trunk_linear_velocity": 3, "trunk_angular_velocity": 3, "joint_velocity": num_joints}
        velocities = tuple(self._drawn(start[name], size) for name, size in sizes.items())
        position = start["trunk_position"] + self._origin
        if any(start["trunk_place"]):
            position[:2] += self._drawn(start["trunk_place"], 2)
        self.robot.reset(position, quaternion(*angles), pose, velocities)
        self.policy.reset()
        self._motors.reset()
        self._draw_command()
        self._heights.clear()
        self._steps = self._now = 0
        self._last_torques, self._peak_force = None, 0.0
        self._actions.restart(self._rng, self.policy.last_action.copy())
        self._measurements.restart(self._rng, self._measured())

    def _measured(self) -> State:
        """Return what sensors measure now."""
        state = self.robot.state()
        pos, vel = self._motors.measured(state.joint_positions, state.joint_velocities)
        return dataclasses.replace(state, joint_positions=pos, joint_velocities=vel)

    def _drawn(self, limits: list[float], size: int | None = None) -> Any:
        """Return one or ``size`` numbers that are drawn uniformly from [lowest, highest]."""
        return self._rng.uniform(limits[0], limits[1], size)

    def _draw_command(self) -> None:
        """Draw a command, and a heading if yaw rates follow one."""
        self.command = self._rng.uniform(*self._command_range)
        if "heading" in self._commands:
            self._heading = self._drawn(self._commands["heading"])

    def _follow_heading(self) -> None:
        """Command the yaw rate that turns the trunk to its heading, if there is one, as in training."""
        if "heading" in self._commands:
            x_ahead, y_ahead, _ = heading(self.robot.quat)
            left = (self._heading - math.atan2(y_ahead, x_ahead) + math.pi) % (2.0 * math.pi) - math.pi
            self.command[2] = np.clip(self._commands.get("heading_gain", 0.0) * left, *self._command_range[:, 2])


def evaluate(
    simulation: Simulation, robots: int, steps: int, seed: int, on_step: Callable[[int], None] = lambda robot: None
) -> dict[str, Estimate]:
    """Return the metrics of robots that walk one after the other, and count their steps on the terminal.

    Args:
        simulation: Of the policy; robot i draws with the seed [``seed``, i].
        robots: How many.
        steps: Control steps of each.
        seed: Of all random numbers.
        on_step: Called after every control step with the robot's number.
    """
    sums = []
    with Counter("simulating, step", robots * steps) as counter:
        for number in range(robots):

            def after_step(number: int = number) -> None:
                on_step(number)
                counter.add()

            sums.append(simulation.run(steps, [seed, number], after_step))
    control_step = 1.0 / simulation.policy.description["timing"]["control_frequency"]
    return estimates(ratios(np.array(sums).T, simulation.robot.weight, control_step, simulation.has_losses))


def quaternion(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the quaternion (w, x, y, z) of turns about x, then y, then z of the world [rad]. Shape: (4,)."""
    result = np.zeros(4)
    mujoco.mju_euler2Quat(result, np.array([roll, pitch, yaw]), "XYZ")
    return result


class Latency:
    """Packets that come late to one robot, as :mod:`legged_torque.sim.packets`; time counts in physics steps."""

    def __init__(self, description: dict[str, Any], name: str) -> None:
        """Take an entry of ``latency`` of ``policy.yaml``; without it, packets arrive at once.

        A UserError if its times make no sense.
        """
        cfg, settings, timing = LatencyCfg(), description.get("latency", {}).get(name), description["timing"]
        vars(cfg).update(settings or {})
        cfg.check(f"latency.{name}")
        self.is_needed = settings is not None
        clock = (1.0 / timing["physics_frequency"], timing["decimation"])
        self._times, self._jitter, self._unit_steps = cfg.counted(f"latency.{name}", *clock)
        self._loss = cfg.loss

    def restart(self, rng: np.random.Generator, packet: Any) -> None:
        """Draw a constant time for a new episode, in which the receiver has a packet from the start on."""
        self._rng, self._queue = rng, [(0, packet)]  # arrival and packet; what the receiver has is the first
        self._constant = int(rng.integers(self._times[0], self._times[1] + 1)) if self.is_needed else 0

    def send(self, now: int, packet: Any) -> None:
        """Send a packet, which may get lost."""
        extra = int(self._rng.integers(0, self._jitter + 1)) if self.is_needed else 0
        if not (self.is_needed and self._rng.random() < self._loss):
            self._queue.append((now + (self._constant + extra) * self._unit_steps, packet))

    def received(self, now: int) -> Any:
        """Return the newest packet that has arrived."""
        newest = max(i for i, (arrival, _) in enumerate(self._queue) if arrival <= now)
        self._queue = self._queue[newest:]
        return self._queue[0][1]
