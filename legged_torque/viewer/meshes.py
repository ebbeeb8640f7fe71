"""What a page draws, as triangles."""

from __future__ import annotations

import mujoco
import numpy as np
import trimesh
from PIL import Image
from viser import transforms

from legged_torque.utils.mjcf import DRAWN_GROUPS
from legged_torque.viewer.ground import Ground

GROUND_FACTOR = (0.45, 0.45, 0.45, 1.0)  # of the colors of rough ground: the light is bright


def ground_glb(ground: Ground) -> bytes:
    """Return rough ground as a binary glTF. It has no normals: browsers draw its triangles flat, with sharp edges."""
    picture = Image.fromarray(ground.picture()[::-1])
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture, baseColorFactor=GROUND_FACTOR, metallicFactor=0.0, roughnessFactor=0.95
    )
    visual = trimesh.visual.TextureVisuals(ground.uv, material=material)
    mesh = trimesh.Trimesh(ground.vertices, ground.faces, visual=visual, process=False)
    return trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=False)


def body_glb(model: mujoco.MjModel, body: int) -> bytes | None:
    """Return a body's visual geoms as a binary glTF in its frame, one mesh per material; None if it has none."""
    by_material: dict[int, list[trimesh.Trimesh]] = {}
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] == body and model.geom_group[geom] in DRAWN_GROUPS:
            by_material.setdefault(int(model.geom_matid[geom]), []).append(geom_mesh(model, geom))
    if not by_material:
        return None
    drawing = trimesh.Scene()
    for material, meshes in by_material.items():
        mesh = trimesh.util.concatenate(meshes)
        mesh.visual = trimesh.visual.TextureVisuals(material=pbr_material(model, material))
        drawing.add_geometry(mesh)
    return drawing.export(file_type="glb")


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """Return a geom as triangles in its body's frame; edges of more than 40 degrees stay sharp."""
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
    mesh = trimesh.graph.smooth_shade(mesh, angle=np.radians(40.0))
    pose = np.eye(4)
    pose[:3, :3] = transforms.SO3(model.geom_quat[geom]).as_matrix()
    pose[:3, 3] = model.geom_pos[geom]
    return mesh.apply_transform(pose)


def pbr_material(model: mujoco.MjModel, material: int) -> trimesh.visual.material.PBRMaterial:
    """Return a material of the model for glTF; -1 stands for none."""
    if material < 0:
        return trimesh.visual.material.PBRMaterial(baseColorFactor=(0.5, 0.5, 0.5, 1.0), roughnessFactor=0.7)
    color, shininess = model.mat_rgba[material].copy(), float(model.mat_shininess[material])
    color[:3] **= 2.2  # colors of glTF are linear
    return trimesh.visual.material.PBRMaterial(
        baseColorFactor=tuple(color),
        emissiveFactor=tuple(color[:3] * model.mat_emission[material]),
        metallicFactor=0.2 * float(model.mat_specular[material]),
        roughnessFactor=0.9 - 0.6 * shininess,
    )
