"""Robots on the page: their meshes, from geoms of MuJoCo, and the contacts of one of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser
from viser import transforms

Color = tuple[float, float, float, float]  # red, green, blue and opacity, 0 to 1

SHARP_EDGE = 40.0  # smallest angle of an edge that is not smoothed [degrees]
TINTED = 0.7  # share of a tint in the color of a part
CONTACT_COLOR = (240, 140, 0)
FORCE_LENGTH = 0.002  # of the arrow of a force of 1 N [m]
MIN_FORCE = 1.0  # that is drawn [N]
FORCE_SHAPE: dict[str, Any] = {"shaft_radius": 0.006, "head_radius": 0.016, "head_length": 0.03}  # [m]
POINT_SHAPE: dict[str, Any] = {"point_size": 0.02, "point_shape": "circle", "precision": "float32"}


class Robots:
    """Drawings of equal robots. Browsers get their meshes when the first robot is drawn."""

    def __init__(
        self, scene: viser.SceneApi, name: str, data: mujoco.MjData, geoms: Iterable[int], tint: Color | None = None
    ) -> None:
        """Prepare drawings below the node ``name``, of those geoms that belong to the robot; ``data`` is changed."""
        self._scene, self._name, self._data, self._tint, model = scene, name, data, tint, data.model
        self._geoms: dict[tuple[int, Color], list[int]] = {}  # by body and color
        for geom in geoms:
            material = model.geom_matid[geom]
            rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
            if body := int(model.geom_bodyid[geom]):
                self._geoms.setdefault((body, tuple(rgba.tolist())), []).append(geom)
        self._handles: list[viser.BatchedMeshHandle] = []

    def draw(self, qpos: np.ndarray) -> None:
        """Draw robots at some positions, or none. Shape: (robots, nq)."""
        if len(qpos) and not self._handles:
            self._handles = [self._add(*part, geoms) for part, geoms in self._geoms.items()]
        positions, quats = body_poses(self._data, qpos)
        for (body, _), handle in zip(self._geoms, self._handles, strict=False):
            handle.visible = len(qpos) > 0
            if handle.visible:
                handle.batched_positions, handle.batched_wxyzs = positions[:, body], quats[:, body]

    def _add(self, body: int, color: Color, geoms: Sequence[int]) -> viser.BatchedMeshHandle:
        """Add geoms of a body that have the same color."""
        model, rgba = self._data.model, np.array(color)
        if self._tint:
            rgba = np.array([*(rgba[:3] + TINTED * (np.array(self._tint[:3]) - rgba[:3])), self._tint[3]])
        mesh = trimesh.util.concatenate([geom_mesh(model, geom) for geom in geoms])
        return self._scene.add_batched_meshes_simple(
            f"{self._name}/{model.body(body).name}/{geoms[0]}",
            mesh.vertices,
            mesh.faces,
            batched_wxyzs=np.array([[1.0, 0.0, 0.0, 0.0]]),
            batched_positions=np.zeros((1, 3)),
            batched_colors=rgba[:3],
            opacity=None if rgba[3] == 1.0 else rgba[3],
            lod="off",
            cast_shadow=rgba[3] == 1.0,
        )


class Contacts:
    """Points and arrows of the ground's forces on the collision geoms of one robot."""

    def __init__(self, scene: viser.SceneApi, name: str, data: mujoco.MjData, geoms: Sequence[str]) -> None:
        """Prepare drawings below the node ``name``; ``geoms`` are the names of the collision geoms."""
        self._data, model = data, data.model
        self._geoms = [(int(model.geom(geom).bodyid[0]), geom_mesh(model, model.geom(geom).id)) for geom in geoms]
        nowhere = np.zeros((1, 2, 3))
        self._arrows = scene.add_arrows(f"{name}/forces", nowhere, CONTACT_COLOR, **FORCE_SHAPE, visible=False)
        points = (f"{name}/points", nowhere[0, :1], CONTACT_COLOR)
        self._points = scene.add_point_cloud(*points, **POINT_SHAPE, visible=False)

    def draw(self, qpos: np.ndarray, forces: np.ndarray) -> None:
        """Draw forces in the world [N] at the lowest points of geoms, or none. Shapes: (1, nq), (geoms or 0, 3)."""
        positions, quats = body_poses(self._data, qpos)
        touching = np.flatnonzero(np.linalg.norm(forces, axis=1) > MIN_FORCE).tolist()
        self._arrows.visible = self._points.visible = bool(touching)
        if touching:
            points = []
            for body, mesh in (self._geoms[geom] for geom in touching):
                corners = mesh.vertices @ transforms.SO3(quats[0, body]).as_matrix().T
                points.append(corners[corners[:, 2].argmin()] + positions[0, body])
            self._points.points = np.array(points, np.float32)
            self._arrows.points = np.stack([points, points + FORCE_LENGTH * forces[touching]], axis=1)


def body_poses(data: mujoco.MjData, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses of all bodies. Shapes: (robots, nq) to (robots, nbody, 3) [m] and (robots, nbody, 4)."""
    positions, quats = (np.zeros((len(qpos), data.model.nbody, size), np.float32) for size in (3, 4))
    for robot, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(data.model, data)
        positions[robot], quats[robot] = data.xpos, data.xquat
    return positions, quats


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """Return a geom in its body's frame."""
    kinds, creation = mujoco.mjtGeom, trimesh.creation
    kind, size = kinds(model.geom_type[geom]), model.geom_size[geom]
    if kind == kinds.mjGEOM_MESH:
        part = model.mesh(model.geom_dataid[geom])
        vertices = model.mesh_vert[part.vertadr[0] :][: part.vertnum[0]]
        faces = model.mesh_face[part.faceadr[0] :][: part.facenum[0]]
        mesh = trimesh.Trimesh(vertices, faces)
    else:
        makers = {
            kinds.mjGEOM_SPHERE: lambda: creation.icosphere(subdivisions=3, radius=size[0]),
            kinds.mjGEOM_CAPSULE: lambda: creation.capsule(height=2.0 * size[1], radius=size[0], count=(16, 16)),
            kinds.mjGEOM_CYLINDER: lambda: creation.cylinder(radius=size[0], height=2.0 * size[1], sections=40),
            kinds.mjGEOM_ELLIPSOID: lambda: creation.icosphere(subdivisions=3).apply_scale(size),
        }
        mesh = makers.get(kind, lambda: creation.box(extents=2.0 * size))()
    mesh = trimesh.graph.smooth_shade(mesh, angle=np.radians(SHARP_EDGE))
    pose = np.eye(4)
    pose[:3, :3] = transforms.SO3(model.geom_quat[geom]).as_matrix()
    pose[:3, 3] = model.geom_pos[geom]
    return mesh.apply_transform(pose)
