"""The surface of rough ground: heights on a grid, and the triangles between them.

All that knows rough ground takes one :class:`HeightMap`: rewards, the height scan, contacts, MuJoCo's ``hfield``,
viewers. A cell between four samples is two triangles, which meet in the diagonal from sample (i, j) to (i + 1, j + 1).
That is how MuJoCo divides the cells of an ``hfield``, for contacts and for rays, and how MuJoCo Warp does.
"""

import numpy as np
import torch
from torch import Tensor

from legged_torque.terrain.height_grid import HeightGrid


class HeightMap(HeightGrid):
    """The surface of a grid of heights, on a device.

    Outside of the grid, the ground goes on as it is at the nearest place of the grid's edge.

    Attributes:
        samples: The heights on the device. It has one axis, so that it is never taken for a row per world.
            Shape: (rows * cols,).
    """

    def __init__(self, heights: np.ndarray, horizontal_scale: float, corner: tuple[float, float], device: str) -> None:
        """Keep heights of shape (rows, cols), at least two of each, here and on the device."""
        super().__init__(heights, horizontal_scale, corner)
        self.samples = torch.as_tensor(self.heights, device=device).flatten()

    def height(self, points: Tensor) -> Tensor:
        """Return the height of the surface at x and y of points [m]. Shapes: (..., 2 or more) to (...,).

        Points whose x or y is not a number have the height of some sample, not an error.
        """
        return self.height_at(points[..., 0], points[..., 1])

    def height_at(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the same for x and y by themselves, which a GPU need not write for that [m]. Shapes: (...,)."""
        rows, cols = self.heights.shape
        row, x = self._along(x, self.corner[0], rows)
        col, y = self._along(y, self.corner[1], cols)
        corner = row * cols + col
        is_along_x = x >= y  # the triangle below the diagonal, whose third corner is the next sample along x
        low = self._sample(corner, x)
        third = self._sample(corner + torch.where(is_along_x, cols, 1), x)
        first, second = third - low, self._sample(corner + (cols + 1), x) - third
        slope_x, slope_y = torch.where(is_along_x, first, second), torch.where(is_along_x, second, first)
        return low + slope_x * x + slope_y * y

    def _along(self, place: Tensor, start: float, count: int) -> tuple[Tensor, Tensor]:
        """Return in which cell of an axis places are, and where in it, from 0 to 1."""
        cells = ((place.nan_to_num() - start) / self.horizontal_scale).clamp(0.0, count - 1.0)
        cell = cells.floor().clamp(max=count - 2.0)
        return cell.long(), cells - cell

    def _sample(self, index: Tensor, like: Tensor) -> Tensor:
        """Return samples with the precision of another tensor."""
        inside: Tensor = torch.ops.aten._unsafe_index(self.samples, [index])  # a GPU need not check what is clamped
        return inside.to(like.dtype)
