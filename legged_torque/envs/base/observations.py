"""What policy and critic see: one list of terms, from which sizes, noise, history and mirror images follow."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.height_scan import CLIP, OFFSET, HeightScan, LateScan
from legged_torque.utils.errors import UserError
from legged_torque.utils.mirroring import AXIAL_VECTOR, PLANAR_VELOCITY, SCALAR, VECTOR, Mirroring

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot


@dataclass
class ObservationTerm:
    """One part of the observations."""

    name: str  # also in ``policy.yaml``
    value: Callable[[], Tensor]  # returns the unscaled values. Shape: (num_envs, size)
    mirror: Mirroring | None  # left-right mirror image; None: not known, learning from mirror images is refused
    scale: float | Sequence[float] = 1.0  # factor on all values, or on each
    noise: float = 0.0  # largest error of the policy's sensor, uniform, before scaling
    privileged: bool = False  # whether only the critic sees it
    unit: str = ""  # of the values
    frame: str = "none"  # in which they are given: "trunk", "joint" or "none"
    meaning: str = ""  # what they are


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


def standard_terms(task: LeggedRobot) -> list[ObservationTerm]:
    """Return the terms of all tasks: what a real robot can measure (paper, App. I-B), then what only a simulator knows.

    Scales are those of ``normalization.obs_scales``, errors those of ``noise.noise_scales``.
    """
    scales, noise, symmetry = task.cfg.normalization.obs_scales, task.cfg.noise.noise_scales, task.symmetry
    command_scales = (scales.lin_vel, scales.lin_vel, scales.ang_vel)
    joints, feet = symmetry.joints, symmetry.feet
    actions = joints and Mirroring.joined([joints] * len(task.action_terms()))
    parameters = [mirror for mirror in task.parameter_mirrors.values() if mirror]
    parameter_mirror = Mirroring.joined(parameters) if len(parameters) == len(task.parameter_mirrors) else None

    def term(
        name: str, value: Any, mirror: Mirroring | None, scale: Any = 1.0, error: float = 0.0, privileged: bool = False
    ) -> ObservationTerm:
        return ObservationTerm(name, value, mirror, scale, error, privileged, *_DESCRIPTIONS.get(name, ()))

    terms = [
        term("projected_gravity", lambda: task.projected_gravity, VECTOR, error=noise.gravity),
        term("angular_velocity", lambda: task.base_ang_vel, AXIAL_VECTOR, scales.ang_vel, noise.ang_vel),
        term("command", lambda: task.commands, PLANAR_VELOCITY, command_scales),
        term("joint_position", lambda: task.dof_pos - task.default_dof_pos, joints, scales.dof_pos, noise.dof_pos),
        term("joint_velocity", lambda: task.dof_vel, joints, scales.dof_vel, noise.dof_vel),
        term("last_action", lambda: task.actions, actions),
        term("linear_velocity", lambda: task.base_lin_vel, VECTOR, scales.lin_vel, privileged=True),
        term("height", lambda: task.base_height.unsqueeze(1), SCALAR, privileged=True),
        term("feet_contact", lambda: task.feet_contact, feet, privileged=True),
        term("random_parameters", lambda: task.randomization.values, parameter_mirror, privileged=True),
    ]
    ground = task.cfg.terrain
    if ground.mesh_type == "heightfield":
        scan = HeightScan(task)
        seen: HeightScan | LateScan = scan
        factors = (scales.height_measurements, noise.height_measurements)
        if ground.measure_heights and ground.measure_delay:
            seen = LateScan(task, scan, ground.measure_delay)
            terms.append(term("height_scan_now", scan, scan.mirror, *factors, privileged=True))
        terms.append(term("height_scan", seen, scan.mirror, *factors, privileged=not ground.measure_heights))
    return terms


class Observations:
    """Computes the observations of a list of terms.

    Attributes:
        terms: The terms: those of the policy, then those of the critic alone.
        sizes: Numbers of each term, by name.
        policy_size: Numbers that the policy sees of one step.
        buffers: Groups "policy", with noise and history, and "critic", without; NaN where a term was not finite.
            Shapes: (num_envs, size).
    """

    def __init__(
        self, terms: Sequence[ObservationTerm], history_length: int, clip: float, add_noise: bool, num_envs: int
    ) -> None:
        """Allocate the buffers. Observations are clipped to +-``clip``; ``add_noise`` is for the policy alone."""
        self.terms = sorted(terms, key=lambda term: term.privileged)
        values = [term.value() for term in self.terms]
        device = values[0].device
        self.sizes: dict[str, int] = {}
        for term, value in zip(self.terms, values, strict=True):
            _check(term, value.shape[1], self.sizes)
            self.sizes[term.name] = value.shape[1]
        self._history_length, self._clip, self._add_noise = history_length, clip, add_noise
        scales = [_per_value(term.scale, self.sizes[term.name]) for term in self.terms]
        errors = [[term.noise * factor for factor in scale] for term, scale in zip(self.terms, scales, strict=True)]
        self._scales = torch.tensor([*chain(*scales)], dtype=torch.float32, device=device)
        self.policy_size = sum(self.sizes[term.name] for term in self.policy_terms())
        self._noise = torch.tensor([*chain(*errors)][: self.policy_size], dtype=torch.float32, device=device)
        sizes = {"policy": self.policy_size * history_length, "critic": len(self._scales)}
        groups = {name: torch.zeros(num_envs, size, device=device) for name, size in sizes.items()}
        self.buffers = TensorDict(groups, batch_size=[num_envs], device=device)
        self._policy, self._critic = groups["policy"], groups["critic"]

    def policy_terms(self) -> list[ObservationTerm]:
        """Return the terms that the policy sees."""
        return [term for term in self.terms if not term.privileged]

    def policy_columns(self, name: str) -> list[int]:
        """Return where a term stands in the policy's observations, in every step of the history."""
        names = [term.name for term in self.policy_terms()]
        start = sum(self.sizes[before] for before in names[: names.index(name)])
        columns = range(start, start + self.sizes[name])
        return [step * self.policy_size + column for step in range(self._history_length) for column in columns]

    def compute(self, is_new: Tensor) -> None:
        """Compute the observations of this moment.

        Where an episode has just started, as ``is_new`` says, the history starts with copies. Shape: (num_envs,), bool.
        """
        critic = torch.cat([term.value() for term in self.terms], dim=1) * self._scales
        critic = critic.nan_to_num(nan=math.nan, posinf=math.nan, neginf=math.nan)  # not clipped: it must be noticed
        policy = critic[:, : self.policy_size]
        if self._add_noise:
            policy = torch.addcmul(policy, self._noise, 2.0 * torch.rand(policy.shape, device=policy.device) - 1.0)
        policy = policy.clamp(-self._clip, self._clip)
        self._policy.copy_(self._with_history(policy, is_new))
        self._critic.copy_(critic.clamp(-self._clip, self._clip))

    def _with_history(self, policy: Tensor, is_new: Tensor) -> Tensor:
        """Return the policy's observations followed by those of the steps before."""
        if self._history_length == 1:
            return policy
        before = self._policy[:, : -policy.shape[1]]
        copies = policy.repeat(1, self._history_length - 1)
        return torch.cat([policy, torch.where(is_new.unsqueeze(1), copies, before)], dim=1)

    def mirrors(self) -> dict[str, list[tuple[str, Mirroring | None]]]:
        """Return the mirror images of the groups, term by term with their names."""
        policy = [(term.name, term.mirror) for term in self.policy_terms()]
        critic = [(term.name, term.mirror) for term in self.terms]
        return {"policy": policy * self._history_length, "critic": critic}


def _check(term: ObservationTerm, size: int, before: dict[str, int]) -> None:
    """Raise a UserError if a term has a name twice, or other numbers of scales or mirrored values than of values."""
    if term.name in before:
        raise UserError(f"two observation terms are called '{term.name}'")
    scales, mirrored = len(_per_value(term.scale, size)), len(term.mirror.order) if term.mirror else size
    if (scales, mirrored) != (size, size):
        raise UserError(
            f"observation '{term.name}' has {size} values, {scales} scales and {mirrored} in its mirror image"
        )


def _per_value(value: float | Sequence[float], size: int) -> list[float]:
    """Return one number per value of a term."""
    return [value] * size if isinstance(value, (int, float)) else list(value)
