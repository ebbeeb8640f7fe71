"""Plain MuJoCo on a height map, where that can be exact: a plane under each foot."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np

from legged_torque.sim.height_map import HeightMap
from legged_torque.sim.model import FLOOR, build_model

_LEVEL = 1e-5  # [m] by which ground that is a plane may differ from it
_AT_FIRST = {"pos": [0.1, 0.2, 0.3], "quat": [1.0, 0.1, 0.2, 0.3]}  # poses that MuJoCo takes for simple are final


class PlanePerFoot:
    """A robot whose spherical feet touch nothing but a plane each, posed like the ground under it.

    MuJoCo's own contacts with an ``hfield`` are no truth: sides of its prisms act as edges that are not there.

    Attributes:
        model: The model; :meth:`pose` changes it.
    """

    def __init__(self, spec: mujoco.MjSpec, feet: list[str], height_map: HeightMap) -> None:
        """Compile a robot that stands on a plane, from its specification, which changes."""
        floor, self._map, self._feet = spec.geom(FLOOR), height_map, feet
        names = ("friction", "solref", "solimp", "solmix", "priority", "condim")
        feel = {name: getattr(floor, name) for name in names}
        for k, foot in enumerate(feet):
            spec.geom(foot).contype, spec.geom(foot).conaffinity = 0, 2 << k
            kind = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0.0, 0.0, 1.0], "contype": 2 << k, "conaffinity": 0}
            spec.worldbody.add_geom(name=f"under_{foot}", **kind, **_AT_FIRST, **feel)
        floor.contype, floor.conaffinity = 2 << len(feet), 0  # which nothing touches
        self.model = build_model(spec, [])

    def pose(self, model: mujoco.MjModel, data: mujoco.MjData) -> bool:
        """Pose the planes of :attr:`model`, or a copy, for a state.

        Returns whether nothing else matters: the ground is lower than all other parts, and near each foot it is a
        plane or lower, too.
        """
        mujoco.mj_kinematics(model, data)
        is_exact = True
        for geom in range(model.ngeom):
            if not model.geom_bodyid[geom] or not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
                continue
            name = model.geom(geom).name
            for point, radius in _ends(model, data, geom):
                places, heights = self._near(point, radius)
                is_near = heights.max() >= point[2] - radius
                if name in self._feet:
                    slopes, height = self._triangle(point)
                    plane = model.geom(f"under_{name}").id
                    model.geom_pos[plane], model.geom_quat[plane] = [*point[:2], height], _upwards(slopes)
                    is_near &= np.abs(height + (places - point[:2]) @ slopes - heights).max() > _LEVEL
                is_exact &= not is_near
        return bool(is_exact)

    def _near(self, point: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return x, y and heights of the corners of all cells that are so near along x or y."""
        scale, corner, shape = self._map.horizontal_scale, self._map.corner, self._map.heights.shape
        first, last = (np.floor((point[:2] + side * radius - corner) / scale).astype(int) for side in (-1, 1))
        index = np.stack(np.meshgrid(*map(np.arange, first, last + 2), indexing="ij"), axis=-1).reshape(-1, 2)
        return corner + scale * index, self._map.heights[tuple(index.clip(0, np.array(shape) - 1).T)].astype(float)

    def _triangle(self, point: np.ndarray) -> tuple[np.ndarray, float]:
        """Return slopes along x and y, and height, of the triangle under a point; see :class:`HeightMap`."""
        places, (low, left, ahead, far) = self._near(point, 0.0)  # by columns first
        x, y = along = (point[:2] - places[0]) / self._map.horizontal_scale
        rises = np.array([ahead - low, far - ahead] if x >= y else [far - left, left - low])
        return rises / self._map.horizontal_scale, low + rises @ along


def _ends(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> list[tuple[np.ndarray, float]]:
    """Return the points of a geom that can touch the ground first, and how thick it is around them [m]."""
    centre, turn, size = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        return [(centre + turn @ (size * signs), 0.0) for signs in itertools.product((-1, 1), repeat=3)]
    half = size[1] if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
    return [(centre + side * half * turn[:, 2], size[0]) for side in (-1, 1)]


def _upwards(slopes: np.ndarray) -> np.ndarray:
    """Return the quaternion (w, x, y, z) that turns z to the normal of a plane with some slopes."""
    normal = np.array([*-slopes, 1.0]) / np.sqrt(1.0 + slopes @ slopes)
    quat = np.array([1.0 + normal[2], -normal[1], normal[0], 0.0])
    return quat / np.linalg.norm(quat)
