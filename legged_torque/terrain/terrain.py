"""The interface of grounds, and the plane. All points are in the world frame [m]; nothing here waits for the host."""

from typing import Any

import mujoco
import torch
from torch import Tensor

from legged_torque.terrain.height_map import HeightMap


class Terrain:
    """The ground under all worlds. By default episodes start at the world's origin, and nothing changes with them."""

    map: HeightMap | None = None
    """Its surface, unless it is a plane."""

    @classmethod
    def build(cls, settings: Any, num_envs: int, device: str) -> "Terrain":
        """Return the ground for a section ``terrain`` of settings, which :class:`Plane` does not need."""
        return cls()

    def add_to(self, spec: mujoco.MjSpec, floor: str) -> None:
        """Put this ground into a robot's MJCF in place of its plane, the geom ``floor`` of the world."""
        raise NotImplementedError(f"{type(self).__name__} has no add_to")

    def height(self, points: Tensor) -> Tensor:
        """Return the height of the ground at x and y of points [m]. Shapes: (..., 3) to (...,)."""
        raise NotImplementedError(f"{type(self).__name__} has no height")

    def normal(self, points: Tensor) -> Tensor:
        """Return the unit normal of the ground under points, upwards. Shapes: (..., 3)."""
        raise NotImplementedError(f"{type(self).__name__} has no normal")

    def height_above(self, points: Tensor) -> Tensor:
        """Return how high points are above the ground under them [m]. Shapes: (..., 3), (...,)."""
        return points[..., 2] - self.height(points)

    def move_to_origin(self, mask: Tensor, base_pos: Tensor) -> None:
        """Move trunks, placed as if the world's origin were 0, to where episodes of their worlds start.

        Of the worlds in ``mask`` (num_envs,), bool, ``base_pos`` is changed in place. Shape: (num_envs, 3).
        """

    def end_episodes(self, mask: Tensor, base_pos: Tensor, commands: Tensor, episode_length_s: float) -> None:
        """Learn from the episodes that end in the worlds of ``mask``, before :meth:`move_to_origin` begins the next.

        They last ``episode_length_s`` at most. Trunks have got to ``base_pos`` under ``commands``: v_x, v_y [m/s] and
        yaw rate. Shapes: (num_envs,), bool; (num_envs, 3) both.
        """

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return the scalars by which one sees how hard the ground is, for logging."""
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """Return what differs between worlds and changes from episode to episode."""
        return {}


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

    def height_above(self, points: Tensor) -> Tensor:
        """Return z, without a kernel."""
        return points[..., 2]
