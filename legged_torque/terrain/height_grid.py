"""Heights on a grid, as hosts and MuJoCo need them."""

import mujoco
import numpy as np

_BASE = 1.0  # [m] how thick MuJoCo's ground is below its lowest place


class HeightGrid:
    """Ground whose height is given on a grid in x and y of the world.

    Attributes:
        heights: Heights of the samples [m], along x and y. Shape: (rows, cols), float32.
        horizontal_scale: Distance between neighbouring samples [m].
        corner: x and y of sample (0, 0) [m].
        size: Extent of the grid along x and y [m].
    """

    def __init__(self, heights: np.ndarray, horizontal_scale: float, corner: tuple[float, float]) -> None:
        """Keep heights of shape (rows, cols), at least two of each."""
        self.heights = np.ascontiguousarray(heights, dtype=np.float32)
        self.horizontal_scale, self.corner = horizontal_scale, corner
        rows, cols = self.heights.shape
        self.size = ((rows - 1) * horizontal_scale, (cols - 1) * horizontal_scale)

    def add_to(self, spec: mujoco.MjSpec, floor: str) -> None:
        """Make the geom ``floor`` of the world, usually a plane, a height field with this surface.

        Friction and all else of the geom stay. MuJoCo keeps heights as shares of their range, in single precision, and
        has nothing outside of the grid.
        """
        heights = self.heights.T  # a row of MuJoCo's is along x
        lowest, highest = float(heights.min()), float(heights.max())
        x, y = (0.5 * side for side in self.size)
        spec.add_hfield(
            name=floor,
            nrow=heights.shape[0],
            ncol=heights.shape[1],
            size=[x, y, max(highest - lowest, 1e-3), _BASE],  # level ground must have a height, too
            userdata=np.ascontiguousarray(heights, dtype=float).ravel(),  # MuJoCo reads float32 five times as slowly
        )
        geom = next(geom for geom in spec.worldbody.geoms if geom.name == floor)
        geom.type, geom.hfieldname = mujoco.mjtGeom.mjGEOM_HFIELD, floor
        geom.pos = [self.corner[0] + x, self.corner[1] + y, lowest]
        geom.quat, geom.alt.type = [1.0, 0.0, 0.0, 0.0], mujoco.mjtOrientation.mjORIENTATION_QUAT
