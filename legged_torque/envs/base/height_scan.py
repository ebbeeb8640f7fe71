"""The height scan: how high the ground is around the trunk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from legged_torque.utils.math import quat_rotate_yaw, rotate_yaw
from legged_torque.utils.mirroring import Mirroring

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot

OFFSET, CLIP = 0.5, 1.0
"""A scan is how far the ground is below a plane this much below the trunk's origin, at most so far either way [m]."""


class HeightScan:
    """Measures heights at points that move and turn with the trunk, but stay level, as legged_gym's.

    Attributes:
        offsets: The points: x, y to the trunk's origin along its heading, and 0 [m]; y runs first. Shape: (points, 3).
        mirror: Where each point's mirror image is; None if there is none.
    """

    def __init__(self, task: LeggedRobot) -> None:
        """Prepare the points ``measured_points_x`` by ``measured_points_y`` of ``terrain``."""
        xs, ys = task.cfg.terrain.measured_points_x, task.cfg.terrain.measured_points_y
        points = [(x, y, 0.0) for x in xs for y in ys]
        self._task, self.offsets = task, torch.tensor(points, device=task.device)
        places = {point: place for place, point in enumerate(points)}
        images = [places.get((x, -y, 0.0)) for x, y, _ in points]
        order = tuple(image for image in images if image is not None)
        self.mirror = Mirroring(order, (1.0,) * len(points)) if len(order) == len(points) else None

    def points(self) -> Tensor:
        """Return the points in the world, on the level of the trunk's origin [m]. Shape: (num_envs, points, 3)."""
        task = self._task
        return task.base_pos.unsqueeze(1) + quat_rotate_yaw(task.base_quat.unsqueeze(1), self.offsets.unsqueeze(0))

    def __call__(self) -> Tensor:
        """Return the scan of this moment [m]. Shape: (num_envs, points)."""
        task = self._task
        assert task.terrain.map is not None  # only rough ground is scanned
        base_x, base_y, base_z = task.base_pos.unsqueeze(2).unbind(dim=1)
        x, y = rotate_yaw(task.base_quat.unsqueeze(1), self.offsets[:, 0], self.offsets[:, 1])
        height = task.terrain.map.height_at(base_x + x, base_y + y)  # points() would write them: 9 MB of 4096 worlds
        return (base_z - height - OFFSET).clamp(-CLIP, CLIP)


class LateScan:
    """A height scan as it was some control steps ago; what is older than the episode is as at its start."""

    def __init__(self, task: LeggedRobot, scan: HeightScan, steps: int) -> None:
        """Prepare a delay of ``steps``; nothing has been measured yet."""
        self._task, self._scan = task, scan
        # Scans of the steps before, the newest first. Shape: (num_envs, steps, points).
        self._before = torch.zeros(task.num_envs, steps, len(scan.offsets), device=task.device)

    def __call__(self) -> Tensor:
        """Return the late scan, and keep that of this moment [m]. Shape: (num_envs, points)."""
        now = self._scan().unsqueeze(1)
        before = torch.where(self._task.reset_buf.view(-1, 1, 1), now, self._before)
        self._before.copy_(torch.cat([now, before[:, :-1]], dim=1))
        return before[:, -1]
