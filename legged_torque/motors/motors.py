"""What every model of motors does."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor


class Motors(ABC):
    """One motor per joint in each world.

    A model is a subclass with :meth:`apply`, and its name in ``MOTORS``; tasks choose it by ``motors.model``. If it
    also names a Warp function (see :func:`~legged_torque.motors.drive.in_kernel`), it runs inside the physics kernel.
    """

    def __init__(self, num_envs: int, limits: Tensor) -> None:
        """Create motors of full strength."""
        self.limits = limits  # lowest and highest torques [N m]. Shape: (2, num_dof)
        # Factor on the torques that are asked for, drawn at random. Shape: (num_envs, num_dof).
        self.strength = torch.ones(num_envs, limits.shape[1], device=limits.device)

    @abstractmethod
    def apply(self, wanted: Tensor, dof_vel: Tensor, out: Tensor) -> None:
        """Write to ``out`` the torques that the joints get [N m]; runs at every physics step, inside a CUDA graph.

        ``wanted`` are those that ``_compute_torques`` asks for [N m], ``dof_vel`` in rad/s. Shapes: (num_envs,
        num_dof).
        """
