"""The height scan: how high the ground is around the trunk."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from legged_torque.envs.base.state import RobotState
from legged_torque.sensors.config import SensorCfg
from legged_torque.sensors.sensor import Sensor
from legged_torque.utils.math import quat_rotate_yaw, rotate_yaw
from legged_torque.utils.mirroring import Mirroring

OFFSET, CLIP = 0.5, 1.0
"""A scan is how far the ground is below a plane this much below the trunk's origin, at most so far either way [m]."""


class HeightScan(Sensor):
    """Measures heights at points that move and turn with the trunk, but stay level, as legged_gym's.

    Attributes:
        offsets: The points: x, y to the trunk's origin along its heading, and 0 [m]; y runs first. Shape: (points, 3).
        mirror: Where each point's mirror image is; None if there is none.
    """

    def __init__(self, terrain: Any, state: RobotState) -> None:
        """Prepare the points ``measured_points_x`` by ``measured_points_y`` of the section ``terrain``."""
        points = [(x, y, 0.0) for x in terrain.measured_points_x for y in terrain.measured_points_y]
        self.offsets = torch.tensor(points, device=state.device)
        self.mirror = _mirror(points)
        cfg = SensorCfg()
        cfg.delay = terrain.measure_delay * state.dt
        super().__init__(cfg, state)

    def shape(self) -> tuple[int, ...]:
        """Return the number of points."""
        return (len(self.offsets),)

    def points(self) -> Tensor:
        """Return the points in the world, on the level of the trunk's origin [m]. Shape: (num_envs, points, 3)."""
        state = self.state
        return state.base_pos.unsqueeze(1) + quat_rotate_yaw(state.base_quat.unsqueeze(1), self.offsets.unsqueeze(0))

    def measure(self) -> Tensor:
        """Return the scan of this moment [m]. Shape: (num_envs, points)."""
        state, surface = self.state, self.state.ground.map
        assert surface is not None  # only rough ground is scanned
        base_x, base_y, base_z = state.base_pos.unsqueeze(2).unbind(dim=1)
        x, y = rotate_yaw(state.base_quat.unsqueeze(1), self.offsets[:, 0], self.offsets[:, 1])
        height = surface.height_at(base_x + x, base_y + y)  # points() would write them: 9 MB of 4096 worlds
        return (base_z - height - OFFSET).clamp(-CLIP, CLIP)


def _mirror(points: Sequence[tuple[float, float, float]]) -> Mirroring | None:
    """Return the mirror image of a scan at these points, None if a point has none."""
    places = {point: place for place, point in enumerate(points)}
    images = [places.get((x, -y, 0.0)) for x, y, _ in points]
    order = tuple(image for image in images if image is not None)
    return Mirroring(order, (1.0,) * len(points)) if len(order) == len(points) else None
