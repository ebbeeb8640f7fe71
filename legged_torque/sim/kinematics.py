"""Positions and velocities of points on a robot's bodies in all worlds."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged_torque.sim.engine import Engine, shared_field
from legged_torque.utils.math import cross_matrix, quat_to_matrix

_OF_LINKS = ("body_pos", "body_quat", "jnt_pos", "jnt_axis")


class Fields:
    """The geometry of a robot: fields with a row per world where the engine has such, else one row for all worlds."""

    def __init__(self, sim: Engine) -> None:
        """Copy the model's fields; the engine's rows are looked up at each use."""
        self._shared = {name: shared_field(sim, name) for name in (*_OF_LINKS, "qpos0", "geom_pos")}
        self._per_world = sim.fields if "per_world" in sim.capabilities else {}

    def __getitem__(self, name: str) -> Tensor:
        """Return a field. Shape: (num_envs or 1, ...)."""
        return self._per_world.get(name, self._shared[name])

    def differ(self, names: Sequence[str]) -> bool:
        """Return whether one of these fields has a row per world."""
        return any(name in self._per_world for name in names)


class Points:
    """One point on each of some bodies, all of which hang on the trunk by hinges and slides.

    Positions and velocities are in the world frame, for offsets of the points in their bodies' frames [m], and work
    with any engine. Nothing is kept between calls: each one multiplies a matrix per joint between trunk and point, for
    all points at once. That is torch alone, so it can be captured and compiled.

    A link is the transformation from a body's frame to its parent's: M0 + sin(q) M1 + (1 - cos(q)) M2 + q M3. The last
    row of a 4 x 4 matrix is (0, 0, 0, 1); frames in the world are without it.
    """

    def __init__(self, sim: Engine, fields: Fields, bodies: Sequence[int]) -> None:
        """Prepare for bodies of the engine's model."""
        model, device = sim.mj_model, sim.device
        chains = [links_to(model, body) for body in bodies]
        depth = max(map(len, chains))
        padded = [chain + [(0, 0)] * (depth - len(chain)) for chain in chains]  # the world's pose is the identity
        table = np.array(padded, np.int64).reshape(len(bodies), depth, 2).T  # body or joint, link, point
        self._sim, self._fields = sim, fields
        self._bodies, self._joints = torch.tensor(table, device=device)
        kinds = model.jnt_type[table[1]][..., None, None]
        self._is_hinge = torch.tensor(kinds == mujoco.mjtJoint.mjJNT_HINGE, device=device)
        self._is_slide = torch.tensor(kinds == mujoco.mjtJoint.mjJNT_SLIDE, device=device)
        self._qpos = torch.tensor(model.jnt_qposadr[table[1]], dtype=torch.long, device=device)
        self._qvel = torch.tensor(model.jnt_dofadr[table[1]], dtype=torch.long, device=device)
        self._shared = self._matrices()

    def positions(self, offsets: Tensor) -> Tensor:
        """Return positions [m]. Shapes: (num_envs or 1, points, 3) to (num_envs, points, 3)."""
        frame = self._trunk()
        for link in self._links(*self._angles()).unbind(dim=1):
            frame = _product(frame, link)
        return _applied(frame, offsets)

    def velocities(self, offsets: Tensor) -> Tensor:
        """Return velocities [m/s]. Shapes: (num_envs or 1, points, 3) to (num_envs, points, 3)."""
        frame, (matrices, angle) = self._trunk(), self._angles()
        qvel, speed = self._sim.qvel[:, None], self._sim.qvel[:, self._qvel][..., None, None]
        change = torch.cat([_product(frame[..., :3], cross_matrix(qvel[..., 3:6])), qvel[..., :3, None]], dim=-1)
        of_links = speed * (angle.cos() * matrices[1] + angle.sin() * matrices[2] + matrices[3])
        for link, of_link in zip(self._links(matrices, angle).unbind(dim=1), of_links.unbind(dim=1), strict=True):
            change = _product(change, link) + _product(frame, of_link)
            frame = _product(frame, link)
        return _applied(change, offsets)

    def _trunk(self) -> Tensor:
        """Return the trunk's frame. Shape: (num_envs, 1, 3, 4)."""
        qpos = self._sim.qpos[:, None]
        return torch.cat([quat_to_matrix(qpos[..., 3:7]), qpos[..., :3, None]], dim=-1)

    def _angles(self) -> tuple[Sequence[Tensor], Tensor]:
        """Return the links' matrices M0 to M3, and the angles q. Shape of these: (num_envs, depth, points, 1, 1)."""
        matrices = self._matrices() if self._fields.differ(_OF_LINKS) else self._shared
        return matrices, (self._sim.qpos[:, self._qpos] - self._fields["qpos0"][:, self._qpos])[..., None, None]

    def _links(self, matrices: Sequence[Tensor], angle: Tensor) -> Tensor:
        """Return the links. Shape: (num_envs, depth, points, 4, 4)."""
        return matrices[0] + angle.sin() * matrices[1] + (1.0 - angle.cos()) * matrices[2] + angle * matrices[3]

    def _matrices(self) -> Sequence[Tensor]:
        """Return M0 to M3 of all links. Shape of each: (num_envs or 1, depth, points, 4, 4)."""
        body, joint, fields = self._bodies, self._joints, self._fields
        turned, axis = quat_to_matrix(fields["body_quat"][:, body]), fields["jnt_axis"][:, joint]
        about = _product(turned, cross_matrix(axis))
        twice = _product(about, cross_matrix(axis))
        anchor, slide = fields["jnt_pos"][:, joint, :, None], _product(turned, axis[..., None])
        rest = _four_by_four(turned, fields["body_pos"][:, body, :, None])
        rest[..., 3, 3] = 1.0
        turns = [_four_by_four(part, -_product(part, anchor)) * self._is_hinge for part in (about, twice)]
        return rest, *turns, _four_by_four(torch.zeros_like(turned), slide) * self._is_slide


def links_to(model: mujoco.MjModel, body: int) -> list[tuple[int, int]]:
    """Return the bodies below the trunk on the way to a body, with their joints; 0 stands for none.

    Each joint has an entry, of which only a body's first one names the body.
    """
    links: list[tuple[int, int]] = []
    while model.body_parentid[body]:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        joints = list(range(first, first + count)) or [0]
        links = [*zip([body, *[0] * (len(joints) - 1)], joints, strict=True), *links]
        body = int(model.body_parentid[body])
    return links


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Return the product of matrices without the TF32 of ``@`` on a GPU, which is off by centimetres far away."""
    columns, rows = first.split(1, dim=-1), second.split(1, dim=-2)
    return sum((c * row for c, row in zip(columns[1:], rows[1:], strict=True)), columns[0] * rows[0])


def _applied(frame: Tensor, offsets: Tensor) -> Tensor:
    """Return the points with offsets in a frame, or their velocities, given the frame's change."""
    return (frame[..., :3] * offsets.unsqueeze(-2)).sum(dim=-1) + frame[..., 3]


def _four_by_four(matrix: Tensor, column: Tensor) -> Tensor:
    """Return matrices (..., 3, 3) with columns (..., 3, 1) to their right and zeros below; axes are broadcast."""
    shape = torch.broadcast_shapes(matrix.shape[:-2], column.shape[:-2])
    parts = [matrix.expand(*shape, 3, 3), column.expand(*shape, 3, 1)]
    return torch.nn.functional.pad(torch.cat(parts, dim=-1), (0, 0, 0, 1))
