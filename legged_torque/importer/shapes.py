"""Plain geoms in place of all others: spheres, capsules and boxes, which are cheap and exact on any ground."""

from dataclasses import dataclass

import mujoco
import numpy as np

ROUND = 1.4  # factor between half sizes up to which they make a sphere
LONG = 1.6  # least factor between length and width of a capsule, and largest between its widths
SIZES = {"sphere": 1, "capsule": 2, "box": 3}  # numbers of sizes of the plain kinds
GEOM = mujoco.mjtGeom


@dataclass
class Shape:
    """A sphere, capsule or box in the frame of its body; sizes [m] are those of MuJoCo's geoms."""

    kind: str  # "sphere", "capsule" (along z) or "box"
    size: list[float]
    pos: np.ndarray  # [m]
    quat: np.ndarray  # w, x, y, z
    name: str = ""

    def ends(self) -> np.ndarray:
        """Return the centres of the spheres at its ends, or the corners of the box, in its body's frame [m]."""
        if self.kind == "sphere":
            local = np.zeros((1, 3))
        elif self.kind == "capsule":
            local = np.array([[0, 0, -self.size[1]], [0, 0, self.size[1]]])
        else:
            signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            local = signs * self.size
        return local @ rotation(self.quat).T + self.pos

    def end(self, start: np.ndarray) -> np.ndarray:
        """Return the center of that end of it that is farther from ``start``, in its body's frame [m]. Shape: (3,).

        That is the center of a box's face, or of the sphere at a capsule's end if it lies along the way.
        """
        axes = rotation(self.quat)
        along = axes.T @ (self.pos - start)
        if self.kind == "sphere" or (self.kind == "capsule" and abs(along[2]) < 0.7 * np.linalg.norm(along)):
            return self.pos
        side = 2 if self.kind == "capsule" else int(np.argmax(np.abs(along)))
        return self.pos + axes[:, side] * self.size[1 if self.kind == "capsule" else side] * np.sign(along[side])

    def reach(self, start: np.ndarray) -> float:
        """Return how far it reaches from a point of its body's frame [m]."""
        return float(np.linalg.norm(self.end(start) - start)) + self.radius

    def shorten(self, start: np.ndarray, reach: float) -> None:
        """Move the end of a capsule or box that is farther from ``start`` to this distance from there [m]."""
        half = self.end(start) - self.pos
        length = float(np.linalg.norm(half))
        excess = min(self.reach(start) - reach, length)
        side = 2 if self.kind == "capsule" else int(np.argmax(np.abs(rotation(self.quat).T @ half)))
        if length > 0.0:
            self.pos = self.pos - 0.5 * excess / length * half
            self.size[1 if self.kind == "capsule" else side] -= 0.5 * excess

    def length(self, along: np.ndarray) -> float:
        """Return its length along a direction of its body's frame [m]."""
        return float(np.ptp(self.ends() @ along)) + 2.0 * self.radius

    def half_sizes(self) -> list[float]:
        """Return its half sizes along its axes [m]."""
        if self.kind == "box":
            return self.size
        return [self.size[0], self.size[0], sum(self.size)]

    @property
    def radius(self) -> float:
        """Its thickness around its ends [m]."""
        return 0.0 if self.kind == "box" else self.size[0]


def rotation(quat: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a quaternion. Shape: (3, 3)."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def lowest_point(data: mujoco.MjData, body: int, shape: Shape) -> np.ndarray:
    """Return the center of a shape in the world, at the height of its lowest point [m]. Shape: (3,)."""
    ends = shape.ends() @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
    return np.append(ends.mean(axis=0)[:2], ends[:, 2].min() - shape.radius)


def fit_geom(model: mujoco.MjModel, geom: int) -> tuple[Shape, str]:
    """Return the plain shape of a geom, and the kind that it replaces ("" if the geom is plain).

    A cylinder becomes the capsule inside of it, or the sphere of its radius if it is flat; other geoms are fitted by
    the boxes around them.
    """
    kind, size = GEOM(model.geom_type[geom]), model.geom_size[geom]
    pos, quat = model.geom_pos[geom].copy(), model.geom_quat[geom].copy()
    name = kind.name.removeprefix("mjGEOM_").lower()
    if name in SIZES:
        return Shape(name, size[: SIZES[name]].tolist(), pos, quat), ""
    if kind == GEOM.mjGEOM_CYLINDER:
        if size[1] > size[0]:
            return Shape("capsule", [size[0], size[1] - size[0]], pos, quat), name
        return Shape("sphere", [size[0]], pos, quat), name
    center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    return fit_box(pos + rotation(quat) @ center, quat, half), name


def fit_inertia(model: mujoco.MjModel, body: int) -> Shape:
    """Return the plain shape that has the inertia of a body if filled evenly with its mass."""
    inertia, mass = model.body_inertia[body], model.body_mass[body]
    half = np.sqrt(np.maximum(1.5 * (inertia.sum() - 2 * inertia) / mass, 1e-6))
    return fit_box(model.body_ipos[body].copy(), model.body_iquat[body].copy(), half)


def fit_box(pos: np.ndarray, quat: np.ndarray, half: np.ndarray) -> Shape:
    """Return a sphere, a capsule or a box of about these half sizes [m] along the axes of its frame."""
    order = np.argsort(half)
    small, middle, large = half[order]
    if large < ROUND * small:
        return Shape("sphere", [float(half.mean())], pos, quat)
    if large > LONG * middle and middle < LONG * small:
        radius = float(np.sqrt(small * middle))
        turn, whole = np.zeros(4), np.zeros(4)
        mujoco.mju_quatZ2Vec(turn, np.eye(3)[order[2]])  # from z to the longest axis
        mujoco.mju_mulQuat(whole, quat, turn)
        return Shape("capsule", [radius, float(large - radius)], pos, whole)
    return Shape("box", [float(x) for x in half], pos, quat)


def box_around(shapes: list[Shape], axes: np.ndarray) -> Shape:
    """Return the box around shapes along ``axes``, columns in the body's frame. Shape: (3, 3)."""
    low = np.min([((s.ends() @ axes) - s.radius).min(axis=0) for s in shapes], axis=0)
    high = np.max([((s.ends() @ axes) + s.radius).max(axis=0) for s in shapes], axis=0)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.flatten())
    return Shape("box", [float(x) for x in (high - low) / 2], axes @ ((low + high) / 2), quat)
