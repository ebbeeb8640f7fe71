"""Robots on the page: their meshes, from geoms of MuJoCo to glTF, and the contacts of one of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial
from viser import transforms

Tint = tuple[float, float, float, float]  # red, green, blue and opacity, 0 to 1

SHARP_EDGE = 40.0  # smallest angle of an edge that is not smoothed [degrees]
TINTED = 0.7  # share of a tint in the color of a part
GAMMA = 2.2  # colors of glTF are linear
CONTACT_COLOR = (240, 140, 0)
FORCE_LENGTH = 0.002  # of the arrow of a force of 1 N [m]
MIN_FORCE = 1.0  # that is drawn [N]
FORCE_SHAPE: dict[str, Any] = {"shaft_radius": 0.006, "head_radius": 0.016, "head_length": 0.03}  # [m]
POINT_SHAPE: dict[str, Any] = {"point_size": 0.02, "point_shape": "circle", "precision": "float32"}


class Robots:
    """Drawings of equal robots. Browsers get their meshes when the first robot is drawn."""

    def __init__(
        self, scene: viser.SceneApi, name: str, data: mujoco.MjData, geoms: Iterable[int], tint: Tint | None = None
    ) -> None:
        """Prepare drawings below the node ``name``, of those geoms that belong to the robot; ``data`` is changed."""
        self._scene, self._name, self._data, self._tint = scene, name, data, tint
        self._geoms: dict[int, list[int]] = {}
        for geom in geoms:
            if body := int(data.model.geom_bodyid[geom]):
                self._geoms.setdefault(body, []).append(geom)
        self._handles: dict[int, viser.BatchedGlbHandle] = {}

    def draw(self, qpos: np.ndarray) -> None:
        """Draw robots at some positions, or none. Shape: (robots, nq)."""
        positions, quats = body_poses(self._data, qpos)
        for body, geoms in self._geoms.items():
            if body in self._handles:
                handle = self._handles[body]
                handle.visible = len(qpos) > 0
                if handle.visible:
                    handle.batched_positions, handle.batched_wxyzs = positions[:, body], quats[:, body]
            elif len(qpos):
                model, is_solid = self._data.model, self._tint is None or self._tint[3] == 1.0
                shown = (f"{self._name}/{model.body(body).name}", body_glb(model, geoms, self._tint), quats[:, body])
                self._handles[body] = self._scene.add_batched_glb(
                    *shown, positions[:, body], lod="off", cast_shadow=is_solid
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


def body_glb(model: mujoco.MjModel, geoms: Sequence[int], tint: Tint | None) -> bytes:
    """Return geoms of a body in its frame as a binary glTF with one mesh per material."""
    by_material: dict[int, list[trimesh.Trimesh]] = {}
    for geom in geoms:
        by_material.setdefault(int(model.geom_matid[geom]), []).append(geom_mesh(model, geom))
    drawing = trimesh.Scene()
    for material, meshes in by_material.items():
        mesh = trimesh.util.concatenate(meshes)
        mesh.visual = TextureVisuals(material=pbr_material(model, material, tint))
        drawing.add_geometry(mesh)
    return drawing.export(file_type="glb")


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


def pbr_material(model: mujoco.MjModel, material: int, tint: Tint | None) -> PBRMaterial:
    """Return a material of the model, gray for -1, or one that is tinted."""
    if material < 0:
        color, looks = np.array([0.5, 0.5, 0.5, 1.0]), dict[str, Any](roughnessFactor=0.7)
    else:
        color = model.mat_rgba[material].astype(float)
        color[:3] **= GAMMA
        looks = {
            "emissiveFactor": tuple(color[:3] * model.mat_emission[material]),
            "metallicFactor": 0.2 * float(model.mat_specular[material]),
            "roughnessFactor": 0.9 - 0.6 * float(model.mat_shininess[material]),
        }
    if tint:
        color[:3] += TINTED * (np.array(tint[:3]) ** GAMMA - color[:3])
        color[3] = tint[3]
    return PBRMaterial(baseColorFactor=tuple(color), alphaMode="OPAQUE" if color[3] == 1.0 else "BLEND", **looks)
