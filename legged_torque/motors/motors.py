"""What every model of motors does."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor


class Motors(ABC):
    """One motor per joint in each world.

    Attributes:
        strength: Factor on the torques that are asked for, drawn at random. Shape: (num_envs, num_dof).
        limits: Lowest and highest torques [N m]. Shape: (2, num_dof).
    """

    def __init__(self, num_envs: int, limits: Tensor) -> None:
        """Create motors of full strength.

        Args:
            num_envs: Number of worlds.
            limits: See above.
        """
        self.limits = limits
        self.strength = torch.ones(num_envs, limits.shape[1], device=limits.device)

    @abstractmethod
    def apply(self, wanted: Tensor, dof_vel: Tensor, out: Tensor) -> None:
        """Write the torques that the joints get; runs at every physics step, inside a CUDA graph.

        Args:
            wanted: Torques that ``_compute_torques`` asks for [N m]. Shape: (num_envs, num_dof).
            dof_vel: Joint velocities [rad/s]. Shape: (num_envs, num_dof).
            out: Applied torques [N m]. Shape: (num_envs, num_dof).
        """
