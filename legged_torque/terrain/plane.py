"""Level ground at height 0."""

from __future__ import annotations

import mujoco
import torch
from torch import Tensor

from legged_torque.terrain.terrain import Terrain


class Plane(Terrain):
    """A plane at z = 0, on which every world starts at the origin."""

    def add_to(self, spec: mujoco.MjSpec, floor: str) -> None:
        """Leave the robot's own plane."""

    def height(self, points: Tensor) -> Tensor:
        """Return 0 for each point."""
        return torch.zeros_like(points[..., 2])

    def normal(self, points: Tensor) -> Tensor:
        """Return (0, 0, 1) for each point."""
        normal = torch.zeros_like(points)
        normal[..., 2] = 1.0
        return normal

    def move_to_origin(self, mask: Tensor, base_pos: Tensor) -> None:
        """Leave trunks where they are."""

    def end_episodes(self, mask: Tensor, base_pos: Tensor, commands: Tensor, episode_length_s: float) -> None:
        """Stay as it is."""

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return nothing: a plane is a plane."""
        return {}

    def height_above(self, points: Tensor) -> Tensor:
        """Return z, without a kernel."""
        return points[..., 2]
