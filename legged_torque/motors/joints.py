"""The joints that motors drive, and numbers by joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from legged_torque.utils.errors import UserError, unknown_name


@dataclass(frozen=True)
class Joints:
    """The joints of all worlds, and the clock of their motors."""

    names: list[str]
    torque_limits: Tensor  # lowest and highest torques [N m]. Shape: (2, num_dof)
    armature: Tensor  # reflected inertia of the rotors [kg m^2]. Shape: (num_dof,)
    actions: Tensor  # the newest actions, written before each control step. Shape: (num_envs, num_actions)
    dt: float  # physics step [s]
    decimation: int  # physics steps per control step

    @property
    def num_envs(self) -> int:
        """Number of worlds."""
        return len(self.actions)

    @property
    def device(self) -> str:
        """Device of all tensors."""
        return str(self.actions.device)

    def values(self, setting: str, values: float | dict[str, float]) -> Tensor:
        """Return a setting's numbers by joint; errors of :func:`by_joint`. Shape: (num_dof,)."""
        return torch.tensor(by_joint(setting, values, self.names), device=self.device)


def by_joint(setting: str, values: float | dict[str, float], dof_names: Sequence[str]) -> list[float]:
    """Return a number for each joint: one for all, or by a part of their names, of which the first match counts.

    A UserError, which names the setting, if a joint has no number or a name matches no joint.
    """
    if not isinstance(values, dict):
        return [values] * len(dof_names)
    for part in values:
        if not any(part in name for name in dof_names):
            raise unknown_name(f"joint (part of its name) in {setting}", part, dof_names)
    taken = []
    for name in dof_names:
        matching = [part for part in values if part in name]
        if not matching:
            raise UserError(f"{setting} lacks the joint '{name}'; it has {', '.join(values) or 'no entries'}")
        taken.append(matching[0])
    for part in values:
        if part not in taken:
            raise UserError(f"'{part}' in {setting} has no effect: its joints take a name before it")
    return [values[part] for part in taken]
