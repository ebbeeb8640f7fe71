"""The interface of grounds, which is also the plane. All points are in the world frame [m]."""

from typing import Any

import mujoco
from torch import Tensor

from legged_torque.terrain.height_map import HeightMap


class Terrain:
    """The ground under all worlds: a plane at z = 0, on which every world starts at the origin, and nothing changes.

    Another ground is a subclass in :data:`~legged_torque.terrain.rough.TERRAINS`. Only the constructor may wait for the
    host.
    """

    map: HeightMap | None = None
    """Its surface, unless it is a plane."""

    def __init__(self, settings: Any, num_envs: int, device: str) -> None:
        """Make the ground of a section ``terrain`` of settings, which the plane does not need."""

    def add_to(self, spec: mujoco.MjSpec, floor: str) -> None:
        """Put the map, if there is one, into a robot's MJCF in place of its plane, the geom ``floor`` of the world."""
        if self.map:
            self.map.add_to(spec, floor)

    def height_above(self, points: Tensor) -> Tensor:
        """Return how high points are above the ground under them [m]. Shapes: (..., 3), (...,)."""
        return points[..., 2] - self.map.height(points) if self.map else points[..., 2]

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
