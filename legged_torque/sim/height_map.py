"""The interface of ground that is not a plane, for engines with the capability "height_map"."""

from typing import Protocol

import numpy as np


class HeightMap(Protocol):
    """Heights on a square grid in the world frame, the same for all worlds, and two triangles per cell.

    A cell's diagonal runs from sample (i, j) to (i + 1, j + 1), as in MuJoCo's hfield.
    """

    @property
    def heights(self) -> np.ndarray:
        """Return the heights [m]: rows along x, columns along y, two or more of each. Shape: (rows, cols)."""

    @property
    def horizontal_scale(self) -> float:
        """Return the distance between neighbouring samples [m]."""

    @property
    def corner(self) -> tuple[float, float]:
        """Return x and y of sample (0, 0) [m]."""
