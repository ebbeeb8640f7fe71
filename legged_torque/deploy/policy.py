"""An exported policy in numpy: observations, actions and torques of one robot, without torch or a simulator."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from legged_torque.deploy.description import SCHEMA, from_metadata, metadata, open_network, read, refuse_laws
from legged_torque.motors.twin import constants, without_function
from legged_torque.utils.config import flat
from legged_torque.utils.errors import UserError, refuse
from legged_torque.utils.heading import heading

LARGEST_ACTION = 100.0  # times the clip, where one below 1 counts as 1: saturated networks say some times the clip
IN_OLD_NETWORKS = ("joint_order", "nominal_pose", "observations", "actions")
"""Sections that networks hold which were exported before all sections were stored."""


@dataclass
class State:
    """Measurements of a robot; joints in the policy's order."""

    angular_velocity: np.ndarray  # of the trunk, in its own frame [rad/s]; (3,)
    joint_positions: np.ndarray  # [rad]; (joints,)
    joint_velocities: np.ndarray  # [rad/s]; (joints,)
    projected_gravity: np.ndarray | None = None  # unit vector in the trunk's frame; upright it is (0, 0, -1)
    quaternion: np.ndarray | None = None  # the trunk's orientation (w, x, y, z), in place of the gravity vector; (4,)
    heights: np.ndarray | None = None  # of the trunk's origin above the ground at scan_places of the policy [m]
    terms: dict[str, Any] = field(default_factory=dict)  # unscaled values of the policy's supplied terms, by name

    def gravity(self) -> np.ndarray:
        """Return the unit gravity vector in the trunk's frame. Shape: (3,)."""
        if self.projected_gravity is not None:
            return np.asarray(self.projected_gravity)
        if self.quaternion is None:
            raise ValueError("a state needs projected_gravity or quaternion")
        w, x, y, z = np.asarray(self.quaternion) / np.linalg.norm(self.quaternion)
        return -np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


class Policy:
    """Runs an exported policy for one robot.

    Call :meth:`observation` and :meth:`act` once per control step, and :meth:`torques` at every physics step, or once
    if ``refresh_torques`` is false.

    Attributes:
        description: Contents of ``policy.yaml``.
        joint_order: Names of the joints, in the order of all vectors of joints.
        nominal_pose: Shape: (joints,) [rad].
        stiffness: Gains [N m/rad]. Shape: (joints,).
        damping: Gains [N m s/rad]. Shape: (joints,).
        torque_limits: Lowest and highest torques. Shape: (2, joints) [N m].
        supplied: Observation terms without a function here: :attr:`State.terms` must have their values.
        scan: Entry ``scan`` of the observations; None if the policy does not see the ground.
        scan_points: Where the height scan measures: x along the trunk's heading and y to its left, from the trunk's
            origin. Shape: (points, 2) [m].
        last_action: Actions that acted in the last step, clipped; 0 after a reset. Shape: (actions,).
        session: The network in onnxruntime.
    """

    def __init__(self, path: str | Path) -> None:
        """Load ``policy.yaml``, or ``policy.onnx`` in the same folder, or both of that folder.

        A UserError if a file is missing, damaged or does not fit the other one, or a term has no function here.
        """
        self.description, network = read(path)
        refuse(self.description.get("unsupported", []), f"'{path}' can only be run by its task")
        refuse(parts_without_function(self.description), f"'{path}'")
        self.session = load_network(network, self.description)
        self.joint_order: list[str] = self.description["joint_order"]
        self.nominal_pose = self._by_joint(self.description["nominal_pose"])
        self.torque_limits = self._by_joint(self.description["torque_limits"]).T
        gains = self.description["gains"]
        self.stiffness, self.damping = self._by_joint(gains["stiffness"]), self._by_joint(gains["damping"])
        models = self.description.get("motors", {}).items()
        drives = [constants(m, self.joint_order, f"motors.{name}", 0.0) for name, m in models if m["model"] == "drive"]
        self._drive_gains = [sum(drive[gain] for drive in drives) for gain in ("stiffness", "damping")]
        self._action_terms = self.description["actions"]["terms"]
        self._action_clip = self.description["actions"]["clip"]
        terms = self.description["observations"]["terms"]
        self._observations, sizes = [term["name"] for term in terms], [term["size"] for term in terms]
        self.supplied = [name for name in self._observations if name not in OBSERVATIONS]
        self._scale = np.concatenate([np.full(term["size"], term["scale"], np.float32) for term in terms])
        self._clip: np.ndarray = np.repeat(np.array([term["clip"] for term in terms], np.float32), sizes, axis=0).T
        self._num_kept = sum(term["size"] for term in terms if "group" not in term)  # of which there is a history
        scans = [term["scan"] for term in terms if "scan" in term]
        self.scan: dict[str, Any] | None = scans[0] if scans else None
        points = [(x, y) for scan in scans for x in scan["points_x"] for y in scan["points_y"]]
        self.scan_points = np.array(points, float).reshape(-1, 2)
        self.reset()

    def reset(self) -> None:
        """Start a new episode: forget the last action, the history, and what the network remembers."""
        self._steps = 0
        self.last_action = np.zeros(self.description["network"]["num_actions"], np.float32)
        self._history: np.ndarray | None = None
        self._memory = empty_memory(self.description)

    def observation(self, state: State, command: np.ndarray) -> np.ndarray:
        """Return the network's observations: the newest step, those before, then terms with groups of their own.

        Call it once per control step, since it keeps the history. The command is v_x, v_y [m/s] and the yaw rate
        [rad/s] in the trunk's frame. Shapes: (3,) to (observations,).
        """
        missing = [name for name in self.supplied if name not in state.terms]
        if missing:
            raise ValueError(f"the terms of a state need values of {', '.join(missing)}")
        functions = {name: lambda *_, name=name: state.terms[name] for name in self.supplied} | OBSERVATIONS
        values = [functions[name](self, state, command) for name in self._observations]
        now = np.concatenate([np.asarray(value, np.float32) for value in values])
        if now.shape != self._scale.shape:
            raise ValueError(f"a state and a command make {now.size} observations, not {self._scale.size}")
        now, others = np.split(np.clip(now * self._scale, *self._clip), [self._num_kept])
        if self._history is None:
            self._history = np.tile(now, self.description["observations"]["history_length"])
        else:
            self._history = np.concatenate([now, self._history[: -now.size]])
        return np.concatenate([self._history, others])

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Return clipped mean actions, or held ones where new ones are not due, kept as ``last_action``.

        Call it once per control step. A UserError if they are not finite, or far beyond the clip. Shape: (actions,).
        """
        actions = run_network(self.session, np.asarray(obs, np.float32)[np.newaxis], self._memory)
        if not np.isfinite(actions).all():  # such actions must not reach a robot
            raise UserError("the network's actions are not finite: check the observations")
        worst, largest = int(np.abs(actions).argmax()), LARGEST_ACTION * max(1.0, *np.abs(self._action_clip))
        if abs(action := actions[0, worst]) > largest:
            term, joint = divmod(worst, len(self.joint_order))
            which = f"{self._action_terms[term]['name']} of {self.joint_order[joint]}"
            raise UserError(f"the network's {which} is {action:.4g}, beyond {largest:g}")
        new = np.clip(actions[0], *self._action_clip)
        is_due = np.repeat([self.phase(term["name"]) == 0.0 for term in self._action_terms], len(self.joint_order))
        self.last_action = np.where(is_due, new, self.last_action)
        self._steps += 1
        return self.last_action.copy()

    def torques(self, actions: np.ndarray, joint_positions: np.ndarray, joint_velocities: np.ndarray) -> np.ndarray:
        """Return joint torques [N m] for actions of :meth:`act`, clipped to the limits. Shape: (joints,).

        Joint positions [rad] and velocities [rad/s] are the present ones. Shapes: (joints,). Models of motors in
        ``policy.yaml`` are left out, since a robot has them, but for gains of a ``drive``, see :meth:`drive_targets`.
        A UserError names others of the control law.
        """
        refuse_laws(self.description)
        stiffness, damping = self._drive_gains
        wanted = self.wanted_torques(actions, joint_positions, joint_velocities)
        if np.any(stiffness) or np.any(damping):  # a torque policy without a drive needs no measurements
            wanted += stiffness * (self.nominal_pose - self.joints(joint_positions))
            wanted -= damping * self.joints(joint_velocities)
        return np.clip(wanted, *self.torque_limits)

    def wanted_torques(
        self, actions: np.ndarray, joint_positions: np.ndarray, joint_velocities: np.ndarray
    ) -> np.ndarray:
        """Return what the control law asks the motors for [N m]; arguments as of :meth:`torques`. Shape: (joints,)."""
        actions = np.asarray(actions, np.float32).reshape(len(self._action_terms), len(self.joint_order))
        positions, velocities = self.joints(joint_positions), self.joints(joint_velocities)
        total = np.zeros_like(self.nominal_pose)
        for i, term in enumerate(self._action_terms):
            torques = ACTIONS[term["name"]](self, np.float32(term["scale"]) * actions[i], positions, velocities)
            total += np.float32(term["mixing_weight"]) * torques
        return total

    def drive_targets(self, actions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return tau, q, kp and kd of drives that make tau + kp (q - position) - kd velocity. Shapes: (joints,).

        That is :meth:`wanted_torques`, for position_residual and torque, and a ``drive`` of ``policy.yaml``.
        A UserError names other motors of the control law.
        """
        refuse_laws(self.description)
        q = self.nominal_pose.astype(float)
        tau, kp, kd = np.zeros((3, len(q)))
        for term, values in zip(self._action_terms, actions.reshape(-1, len(q)), strict=True):
            if term["name"] == "torque":
                tau = term["mixing_weight"] * term["scale"] * values.astype(float)
            else:
                q = self.nominal_pose + term["scale"] * values.astype(float)
                kp, kd = (term["mixing_weight"] * gain for gain in (self.stiffness, self.damping))
        stiffness, damping = self._drive_gains  # towards the nominal pose
        q = self.nominal_pose + kp / np.maximum(kp + stiffness, 1e-9) * (q - self.nominal_pose)
        return tau, q, kp + stiffness, kd + damping

    def scan_places(self, position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
        """Return x and y of the points of the height scan in the world, in which the trunk has a pose [m].

        The trunk's position [m] and orientation (w, x, y, z) have shapes (2 or more,), (4,). Shape: (points, 2).
        """
        ahead, left, length = heading(np.asarray(quaternion))
        cos, sin = ahead / length, left / length
        return np.asarray(position)[:2] + self.scan_points @ np.array([[cos, sin], [-sin, cos]])

    def height_scan(self, heights: np.ndarray | None) -> np.ndarray:
        """Return the height scan for heights above the ground. Shapes: (points,) [m]."""
        assert self.scan  # the description has it with the term
        if heights is None or np.shape(heights) != (len(self.scan_points),):
            raise ValueError(f"a state needs {len(self.scan_points)} heights above the ground, at scan_places")
        limit = self.scan["limit"]
        return np.clip(np.asarray(heights, np.float32) - np.float32(self.scan["offset"]), -limit, limit)

    def phase(self, name: str) -> float:
        """Return the share of its interval for which the actions of a term have been held; 0: new ones are due."""
        interval = next((term.get("interval", 1) for term in self._action_terms if term["name"] == name), 1)
        return self._steps % interval / interval

    def _by_joint(self, values: dict[str, Any]) -> np.ndarray:
        """Return values by joint in the policy's order. Shape: (joints, ...)."""
        return np.array([values[name] for name in self.joint_order], np.float32)

    def joints(self, values: np.ndarray) -> np.ndarray:
        """Return one number per joint as float32; a ValueError for others. Shape: (joints,)."""
        values = np.asarray(values, np.float32)
        if values.shape != self.nominal_pose.shape:
            raise ValueError(f"there are {self.nominal_pose.size} joints, the array has shape {values.shape}")
        return values


OBSERVATIONS: dict[str, Callable[[Policy, State, np.ndarray], Any]] = {
    "projected_gravity": lambda policy, state, command: state.gravity(),
    "angular_velocity": lambda policy, state, command: state.angular_velocity,
    "command": lambda policy, state, command: command,
    "joint_position": lambda policy, state, command: policy.joints(state.joint_positions) - policy.nominal_pose,
    "joint_velocity": lambda policy, state, command: policy.joints(state.joint_velocities),
    "last_action": lambda policy, state, command: policy.last_action,
    "position_phase": lambda policy, state, command: [policy.phase("position_residual")],
    "height_scan": lambda policy, state, command: policy.height_scan(state.heights),
}
"""Returns the unscaled values of an observation term, by its name.

Exports compare these with the task's. A task with terms of its own may add their functions here and to :data:`ACTIONS`.
Without one, an observation is marked as ``supplied`` in ``policy.yaml``: whoever runs the policy gives its values in
:attr:`State.terms`. With an action term that has none, the network is exported, and running it here is refused.
"""

ACTIONS: dict[str, Callable[[Policy, np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "position_residual": lambda policy, scaled, q, qd: (
        policy.stiffness * (policy.nominal_pose + scaled - q) - policy.damping * qd
    ),
    "torque": lambda policy, scaled, q, qd: scaled,
}
"""Returns the torques [N m] of an action term for scale times action, q [rad] and qd [rad/s], by the term's name."""


def parts_without_function(description: dict[str, Any]) -> list[str]:
    """Return a line for each action term or motor of a description that has no function here."""
    terms = [
        f"no numpy function for the action term '{term['name']}'; there are {', '.join(ACTIONS)}"
        for term in description["actions"]["terms"]
        if term["name"] not in ACTIONS
    ]
    motors = [name for name, described in description.get("motors", {}).items() if without_function(described)]
    return terms + [f"no numpy function for the motor '{name}'" for name in motors]


def empty_memory(description: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return what a network remembers at the start of an episode, by its inputs. Shapes: (layers, 1, size)."""
    memory = description["network"].get("memory", [])
    return {each["input"]: np.zeros((each["layers"], 1, each["size"]), np.float32) for each in memory}


def run_network(session: Any, obs: np.ndarray, memory: dict[str, np.ndarray]) -> np.ndarray:
    """Return the actions of a network for rows of observations, and let its memory follow. Shape: (rows, actions)."""
    actions, *remembered = session.run(None, {"obs": obs, **memory})
    memory.update(zip(memory, remembered, strict=True))
    return actions


def load_network(file: Path, description: dict[str, Any]) -> Any:
    """Return the network's session; a UserError that names what differs if it is not the network of a description."""
    (session, checksum), network = open_network(file), description["network"]
    nodes = (*session.get_inputs(), *session.get_outputs())
    memory = [(each["input"], each["output"], [each["layers"], each["size"]]) for each in network.get("memory", [])]
    ends = [(node.name, [size for size in node.shape if isinstance(size, int)]) for node in nodes]  # but for the robots
    expected = [("obs", [network["num_observations"]]), *((name, size) for name, _, size in memory)]
    expected += [("actions", [network["num_actions"]]), *((name, size) for _, name, size in memory)]
    if ends != expected:
        raise UserError(f"'{file}' has the input and output {ends}, not {expected}")
    if checksum != network["sha256"]:
        raise UserError(f"'{file}' is not the network that was exported with its policy.yaml (sha256 differs)")
    stored, described = session.get_modelmeta().custom_metadata_map, metadata(description)
    sections = SCHEMA["properties"] if "format_version" in stored else IN_OLD_NETWORKS
    if any(stored.get(section) != described.get(section) for section in sections):
        held, ours = (flat(from_metadata(each, f"'{file}'")) for each in (stored, described))
        wrong = [name for name in ours | held if ours.get(name) != held.get(name) and name.split(".")[0] in sections]
        refuse(wrong[:1], f"'{file}' was exported with another policy.yaml, which was changed in")
    return session
