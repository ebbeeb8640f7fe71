"""The joints that motors drive, and numbers by joint."""

from dataclasses import dataclass

import torch
from torch import Tensor

from legged_torque.motors.config import by_joint


@dataclass(frozen=True)
class Joints:
    """The joints of all worlds, and the clock of their motors."""

    names: list[str]
    torque_limits: Tensor  # lowest and highest torques [N m]. Shape: (2, num_dof)
    armature: Tensor  # reflected inertia of the rotors [kg m^2]. Shape: (num_dof,)
    actions: Tensor  # the newest actions, written before each control step. Shape: (num_envs, num_actions)
    dt: float  # physics step [s]
    decimation: int  # physics steps per control step
    nominal_pose: Tensor  # [rad]. Shape: (num_dof,)
    gains: tuple[Tensor, Tensor]  # Kp [N m/rad] and Kd [N m s/rad] of PD control. Shapes: (num_envs, num_dof)
    section: str = "motors"  # path of the settings of the link that is built

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
