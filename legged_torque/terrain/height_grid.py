"""Heights on a grid, as hosts and MuJoCo need them."""

from __future__ import annotations

import numpy as np


class HeightGrid:
    """Ground whose height is given on a grid in x and y of the world.

    Attributes:
        heights: Heights of the samples [m], along x and y. Shape: (rows, cols), float32.
        horizontal_scale: Distance between neighbouring samples [m].
        corner: x and y of sample (0, 0) [m].
    """

    def __init__(self, heights: np.ndarray, horizontal_scale: float, corner: tuple[float, float]) -> None:
        """Keep heights of shape (rows, cols), at least two of each."""
        self.heights = np.ascontiguousarray(heights, dtype=np.float32)
        self.horizontal_scale, self.corner = horizontal_scale, corner

    @property
    def size(self) -> tuple[float, float]:
        """Extent of the grid along x and y [m]."""
        rows, cols = self.heights.shape
        return (rows - 1) * self.horizontal_scale, (cols - 1) * self.horizontal_scale
