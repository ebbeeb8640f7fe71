"""Ground that is not a plane, as :class:`~legged_torque.sim.simulator.Simulator` takes it."""

from dataclasses import dataclass

import numpy as np

from legged_torque.utils.errors import UserError


@dataclass(frozen=True)
class HeightMap:
    """Heights on a square grid; each cell is two triangles, the diagonal as in MuJoCo's hfield.

    One map for all worlds, in the world frame. A UserError if it is not one of finite numbers with two rows and two
    columns or more, or its cells have no size.
    """

    heights: np.ndarray  # [m]; rows along x, columns along y. Shape: (rows, cols)
    horizontal_scale: float  # side of a cell [m]
    corner: tuple[float, float]  # x and y of the first height [m]

    def __post_init__(self) -> None:
        """Check the numbers."""
        shape = np.shape(self.heights)
        if len(shape) != 2 or min(shape) < 2:
            raise UserError(f"a height map has rows and columns, two or more of each; its shape is {shape}")
        if not np.isfinite(self.heights).all():
            raise UserError("a height map has heights that are not finite")
        if not self.horizontal_scale > 0.0:
            raise UserError(f"horizontal_scale of a height map is {self.horizontal_scale}: more than 0 is allowed")
