"""Observations: one list of terms, from which groups, sizes, noise, history and mirror images follow."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.actions import ControlLaw, ControlParameters
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.state import RobotState
from legged_torque.envs.base.symmetry import RobotSymmetry
from legged_torque.sensors.height_scan import CLIP, OFFSET
from legged_torque.sensors.sensors import Sensors
from legged_torque.utils.buffers import check_tensor
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import NotNegative, check_value
from legged_torque.utils.mirroring import AXIAL_VECTOR, PLANAR_VELOCITY, SCALAR, VECTOR, Mirroring


@dataclass
class ObservationTerm:
    """One part of the observations."""

    name: str  # also in ``policy.yaml``
    value: Callable[[], Tensor]  # returns the unscaled values. Shape: (num_envs, size), of a group of its own any
    mirror: Mirroring | None  # left-right mirror image; None: not known, learning from mirror images is refused
    scale: float | Sequence[float] = 1.0  # factor on all values, or on each
    noise: float = 0.0  # largest error of the policy's sensor, uniform, before scaling
    privileged: bool = False  # whether only the critic sees it
    unit: str = ""  # of the values
    frame: str = "none"  # in which they are given: "trunk", "joint" or "none"
    meaning: str = ""  # what they are
    sensed: Callable[[], Tensor] | None = None  # of the policy in place of value, where that reaches it late
    group: str = ""  # a group of its own, which ``obs_groups`` can give to a network; empty: "policy" and "critic"

    def __post_init__(self) -> None:
        """Raise a UserError if value is no function, or scale or noise are no numbers."""
        scale, kind = self.scale, type(self.value).__name__
        if not callable(self.value):
            raise UserError(f"observation '{self.name}': value must be a function, as lambda: ..., not {kind}")
        scale = scale.tolist() if hasattr(scale, "tolist") else list(scale) if isinstance(scale, Sequence) else scale
        self.scale = check_value(f"observation '{self.name}': scale", scale, float | list[float])
        self.noise = check_value(f"observation '{self.name}': noise", self.noise, NotNegative)


_DESCRIPTIONS = {
    "projected_gravity": ("", "trunk", "unit vector of gravity, (0, 0, -1) when upright"),
    "angular_velocity": ("rad/s", "trunk", "of the trunk"),
    "command": ("m/s, m/s, rad/s", "trunk", "commanded v_x, v_y and yaw rate"),
    "joint_position": ("rad", "joint", "q - nominal_pose"),
    "joint_velocity": ("rad/s", "joint", "qd"),
    "last_action": ("", "none", "clipped actions of the step before, 0 at the start"),
    "height_scan": ("m", "trunk", f"trunk's height - {OFFSET} - ground's, +-{CLIP}; points level, along the heading"),
    "height_scan_now": ("m", "trunk", "height_scan without its delay"),
    "random_parameters": ("", "none", "drawn parameters as shares of their ranges, -1 to 1"),
}
"""Unit, frame and meaning of the standard terms."""


def standard_terms(
    cfg: LeggedRobotCfg,
    state: RobotState,
    control: ControlParameters,
    law: ControlLaw,
    parameters: Tensor,
    parameter_mirrors: Mapping[str, Mirroring | None],
    symmetry: RobotSymmetry,
    sensors: Sensors,
) -> list[ObservationTerm]:
    """Return the terms of all tasks: what a real robot can measure (paper, App. I-B), then what only a simulator knows.

    Scales are those of ``normalization.obs_scales``, errors those of ``noise.noise_scales``.

    Args:
        cfg: Settings of the task.
        state: The robots.
        control: Their nominal pose.
        law: What their actions are.
        parameters: The drawn parameters, see ``Randomization.values``. Shape: (num_envs, any).
        parameter_mirrors: Their mirror images, by name.
        symmetry: Which joints and feet are mirror images of each other.
        sensors: What the policy's sensors have measured.
    """
    scales, noise = cfg.normalization.obs_scales, cfg.noise.noise_scales
    scan, sensing = sensors.height_scan, sensors.sensing
    command_scales = (scales.lin_vel, scales.lin_vel, scales.ang_vel)
    joints, feet = symmetry.joints, symmetry.feet
    actions = joints and Mirroring.joined([mirror for _, mirror in law.mirrors(joints) if mirror])
    images = [mirror for mirror in parameter_mirrors.values() if mirror]
    parameter_mirror = Mirroring.joined(images) if len(images) == len(parameter_mirrors) else None

    def term(
        name: str, value: Any, mirror: Mirroring | None, scale: Any = 1.0, error: float = 0.0, privileged: bool = False
    ) -> ObservationTerm:
        """Return a term of the groups "policy" and "critic", with its description."""
        return ObservationTerm(name, value, mirror, scale, error, privileged, *_DESCRIPTIONS.get(name, ()))

    terms = [
        term("projected_gravity", lambda: state.projected_gravity, VECTOR, error=noise.gravity),
        term("angular_velocity", lambda: state.base_ang_vel, AXIAL_VECTOR, scales.ang_vel, noise.ang_vel),
        term("command", lambda: state.commands, PLANAR_VELOCITY, command_scales),
        term("joint_position", lambda: state.dof_pos - control.default_dof_pos, joints, scales.dof_pos, noise.dof_pos),
        term("joint_velocity", lambda: state.dof_vel, joints, scales.dof_vel, noise.dof_vel),
        term("last_action", lambda: state.actions, actions),
        term("linear_velocity", lambda: state.base_lin_vel, VECTOR, scales.lin_vel, privileged=True),
        term("height", lambda: state.base_height.unsqueeze(1), SCALAR, privileged=True),
        term("feet_contact", lambda: state.feet_contact, feet, privileged=True),
        term("random_parameters", lambda: parameters, parameter_mirror, privileged=True),
    ]
    if sensing:
        late: dict[str, Callable[[], Tensor]] = {
            "projected_gravity": lambda: sensing.projected_gravity,
            "angular_velocity": lambda: sensing.base_ang_vel,
            "joint_position": lambda: sensing.dof_pos - control.default_dof_pos,
            "joint_velocity": lambda: sensing.dof_vel,
        }
        terms = [dataclasses.replace(term, sensed=late.get(term.name)) for term in terms]
    if scan:
        factors, is_seen = (scales.height_measurements, noise.height_measurements), cfg.terrain.measure_heights
        if is_seen and scan.delay:
            terms.append(term("height_scan_now", lambda: scan.newest, scan.mirror, *factors, privileged=True))
        seen = (lambda: scan.values) if is_seen else (lambda: scan.newest)
        terms.append(term("height_scan", seen, scan.mirror, *factors, privileged=not is_seen))
    return terms


class Observations:
    """Computes the observations of a list of terms.

    Attributes:
        terms: The terms of "policy" and "critic": those of the policy, then those of the critic alone.
        sizes: Numbers of each of them, by name.
        policy_size: Numbers that the policy sees of one step.
        groups: Terms with groups of their own, by name of the group.
        buffers: Groups "policy", with noise and history, "critic", without, and others, with noise; NaN where a term
            was not finite. Shapes: (num_envs, size), of others any.
    """

    def __init__(
        self, terms: Sequence[ObservationTerm], history_length: int, clip: float, add_noise: bool, num_envs: int
    ) -> None:
        """Allocate the buffers. Observations are clipped to +-``clip``; ``add_noise`` is not for the critic."""
        self.terms = sorted((term for term in terms if not term.group), key=lambda term: term.privileged)
        self.sizes: dict[str, int] = {}
        if not self.policy_terms():
            raise UserError("observation_terms() must return a term for the policy, or more")
        for term in self.terms:
            _check(term, value := term.value(), num_envs, self.sizes)
            self.sizes[term.name] = value.shape[1]
        device = value.device
        self._history_length, self._clip, self._add_noise = history_length, clip, add_noise
        scales = [_per_value(term.scale, self.sizes[term.name]) for term in self.terms]
        errors = [[term.noise * factor for factor in scale] for term, scale in zip(self.terms, scales, strict=True)]
        self._scales = torch.tensor([*chain(*scales)], dtype=torch.float32, device=device)
        self.policy_size = sum(self.sizes[term.name] for term in self.policy_terms())
        self._noise = torch.tensor([*chain(*errors)][: self.policy_size], dtype=torch.float32, device=device)
        seen, critic = self.policy_size * history_length, len(self._scales)
        shapes: dict[str, tuple[int, ...]] = {"policy": (seen,), "critic": (critic,)}
        self.groups: dict[str, ObservationTerm] = {}
        for term in (term for term in terms if term.group):
            if term.group in shapes:
                raise UserError(f"the observation group '{term.group}' of '{term.name}' exists already")
            if not isinstance(term.scale, (int, float)):
                raise UserError(f"the observation '{term.name}' of a group of its own takes a single scale")
            _check(term, value := term.value(), num_envs, {})
            self.groups[term.group], shapes[term.group] = term, tuple(value.shape[1:])
        self._groups = {name: torch.zeros(num_envs, *shape, device=device) for name, shape in shapes.items()}
        self.buffers = TensorDict(self._groups, batch_size=[num_envs], device=device)
        self._policy, self._critic = self._groups["policy"], self._groups["critic"]

    def policy_terms(self) -> list[ObservationTerm]:
        """Return the terms that the policy sees."""
        return [term for term in self.terms if not term.privileged]

    def policy_columns(self, name: str) -> list[int]:
        """Return where a term stands in the policy's observations, in every step of the history."""
        names = [term.name for term in self.policy_terms()]
        start = sum(self.sizes[before] for before in names[: names.index(name)])
        columns = range(start, start + self.sizes[name])
        return [step * self.policy_size + column for step in range(self._history_length) for column in columns]

    @property
    def history(self) -> Tensor:
        """The policy's observations of the steps before. Shape: (num_envs, policy_size x further steps)."""
        return self._policy[:, self.policy_size :]

    def by_term(self) -> dict[str, Tensor]:
        """Return what the critic sees of each term, and groups of single terms. Shapes: (num_envs, any)."""
        parts = dict(zip(self.sizes, self._critic.split(list(self.sizes.values()), dim=1), strict=True))
        return parts | {term.name: self._groups[group].flatten(1) for group, term in self.groups.items()}

    def compute(self, is_new: Tensor) -> None:
        """Compute the observations of this moment.

        Where an episode has just started, as ``is_new`` says, the history starts with copies. Shape: (num_envs,), bool.
        """
        for name, values in self.look(is_new).items():
            self._groups[name].copy_(values)

    def look(self, is_new: Tensor | None = None) -> dict[str, Tensor]:
        """Return the observations of this moment, by group; the history goes on everywhere without ``is_new``."""
        critic = torch.cat([term.value() for term in self.terms], dim=1) * self._scales
        critic = _marked(critic)  # not clipped: it must be noticed
        policy = critic[:, : self.policy_size]
        if any(term.sensed for term in self.policy_terms()):
            sensed = [(term.sensed or term.value)() for term in self.policy_terms()]
            policy = _marked(torch.cat(sensed, dim=1) * self._scales[: self.policy_size])
        if self._add_noise:
            policy = torch.addcmul(policy, self._noise, 2.0 * torch.rand(policy.shape, device=policy.device) - 1.0)
        policy = policy.clamp(-self._clip, self._clip)
        seen = {"policy": self._with_history(policy, is_new), "critic": critic.clamp(-self._clip, self._clip)}
        return seen | {name: self._of_group(term) for name, term in self.groups.items()}

    def state_dict(self) -> dict[str, Tensor]:
        """Return the groups."""
        return dict(self._groups)

    def mirrors(self) -> dict[str, list[tuple[str, Mirroring | None]]]:
        """Return the mirror images of the groups, term by term with their names."""
        policy = [(term.name, term.mirror) for term in self.policy_terms()]
        critic = [(term.name, term.mirror) for term in self.terms]
        others = {name: [(term.name, term.mirror)] for name, term in self.groups.items()}
        return {"policy": policy * self._history_length, "critic": critic, **others}

    def _of_group(self, term: ObservationTerm) -> Tensor:
        """Return the scaled values of a term with a group of its own."""
        scale: Any = term.scale  # a number
        values = _marked((term.sensed or term.value)() * scale)
        if self._add_noise and term.noise and not term.privileged:
            values = values + term.noise * scale * (2.0 * torch.rand_like(values) - 1.0)
        return values.clamp(-self._clip, self._clip)

    def _with_history(self, policy: Tensor, is_new: Tensor | None) -> Tensor:
        """Return the policy's observations followed by those of the steps before."""
        if self._history_length == 1:
            return policy
        before = self._policy[:, : -policy.shape[1]]
        if is_new is not None:
            copies = policy.repeat(1, self._history_length - 1)
            before = torch.where(is_new.unsqueeze(1), copies, before)
        return torch.cat([policy, before], dim=1)


def _marked(values: Tensor) -> Tensor:
    """Return values with NaN for all that is not finite."""
    return values.nan_to_num(nan=math.nan, posinf=math.nan, neginf=math.nan)


def _check(term: ObservationTerm, values: Tensor, num_envs: int, before: dict[str, int]) -> None:
    """Raise a UserError if a term has a name twice, another shape, or too few or many scales or mirrored values."""
    if term.name in before:
        raise UserError(f"two observation terms are called '{term.name}'")
    if not isinstance(values, Tensor):
        raise UserError(f"observation '{term.name}' must be a tensor, not {values}")
    if len(values.shape) < 2 or len(values) != num_envs or (len(values.shape) > 2 and not term.group):
        wanted = f"({num_envs}, {'...' if term.group else 'size'})"
        raise UserError(f"observation '{term.name}' has the shape {tuple(values.shape)}, not {wanted}")
    if term.sensed:
        check_tensor(f"the sensed observation '{term.name}'", term.sensed(), values.shape, values.device)
    size = math.prod(values.shape[1:])
    scales, mirrored = len(_per_value(term.scale, size)), len(term.mirror.order) if term.mirror else size
    if (scales, mirrored) != (size, size):
        others = f"{scales} scales and {mirrored} in its mirror image"
        raise UserError(f"observation '{term.name}' has {size} values, {others}")


def _per_value(value: float | Sequence[float], size: int) -> list[float]:
    """Return one number per value of a term."""
    return [value] * size if isinstance(value, (int, float)) else list(value)
