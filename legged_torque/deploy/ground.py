"""The ground of a policy's training in plain MuJoCo, and physics steps in which robots touch it as in training.

In MuJoCo, a geom touches every triangle of a height field that it overlaps, each as if it were a column of its own.
Feet that sink into level ground by a centimetre also touch edges of the columns around them, with normals tilted by up
to 60 degrees; where they sink deeper, the shortest way out is sideways. A trained A1 hardly walks there. Corrected
contacts follow the same law as training's, so on rough ground they are no independent evidence.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from legged_torque.terrain.height_grid import HeightGrid
from legged_torque.terrain.layout import Layout
from legged_torque.terrain.selection import COLUMNS, named_kinds, rising_levels, select_tiles
from legged_torque.utils.config import update_from_dict

CONTACT_NOTES = {
    "training": "contacts with height fields are corrected to those of training, so they are not tested independently; "
    "--contacts=mujoco leaves MuJoCo's",
    "mujoco": "contacts with height fields are MuJoCo's own: feet also touch edges inside of level ground",
}
"""Notes on contacts with height fields, by ``--contacts``."""
SAME_FACE = math.cos(math.radians(2.6))  # least cosine between normals of one face, as in training
_ABOVE = 10.0  # height over a place from which rays look down on it [m]
_SPHERE, _CAPSULE = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)


def select_ground(description: dict[str, Any], settings: Any, kinds: Sequence[str], levels: Sequence[float]) -> None:
    """Change the ground of ``policy.yaml`` to tiles of some kinds at some difficulties, by default those of training.

    A policy of a plane takes everything else, such as the size of tiles, from ``settings``, a section ``terrain`` that
    is changed.
    """
    update_from_dict(settings, {**description.get("terrain", {}), "terrain_proportions": {}})
    select_tiles(settings, named_kinds(kinds), rising_levels(levels), COLUMNS)
    description["terrain"] = dataclasses.asdict(Layout.of(settings))


def place_ground(spec: mujoco.MjSpec, description: dict[str, Any], notes: list[str]) -> np.ndarray:
    """Put the ground of ``policy.yaml`` into an MJCF in place of its plane, and return where robots may start.

    An MJCF with other ground than one plane keeps its own. Adds to ``notes`` what is added or kept. Returns the middles
    of all tiles, or the origin. Shape: (tiles, 3) [m]. A UserError if there can be no such ground.
    """
    grounds = [geom for geom in spec.worldbody.geoms if geom.contype or geom.conaffinity]
    if not grounds:
        grounds = [spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05])]
        what = "the ground of policy.yaml" if "terrain" in description else "a plane at height 0"
        notes.append(f"the MJCF has no floor: {what} is added")
    if "terrain" not in description:
        return np.zeros((1, 3))
    if [geom.type for geom in grounds] != [mujoco.mjtGeom.mjGEOM_PLANE]:
        notes.append("the MJCF has ground of its own, on which the robot starts at the origin, not that of policy.yaml")
        return np.zeros((1, 3))
    layout, (floor,) = Layout(**description["terrain"]), grounds
    heights = layout.heights()
    floor.name = floor.name or "floor"
    HeightGrid(heights, layout.horizontal_scale, layout.corner).add_to(spec, floor.name)
    return layout.origins(heights).reshape(-1, 3)


def step(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Do what ``mj_step`` does, with corrected contacts of height fields; RK4 becomes Euler where there are any."""
    if not model.nhfield:
        mujoco.mj_step(model, data)
        return
    mujoco.mj_step1(model, data)
    by_geoms: dict[tuple[int, int], list[mujoco.MjContact]] = {}
    for contact in data.contact:
        hfield, geom = contact.geom.tolist()  # in the order of their types
        if model.geom_type[hfield] == mujoco.mjtGeom.mjGEOM_HFIELD:
            by_geoms.setdefault((hfield, geom), []).append(contact)
    for (hfield, geom), contacts in by_geoms.items():
        _correct(model, data, hfield, geom, sorted(contacts, key=lambda contact: contact.dist))
    if by_geoms:
        mujoco.mj_makeConstraint(model, data)
        mujoco.mj_island(model, data)
        mujoco.mj_projectConstraint(model, data)
        mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_step2(model, data)


def _correct(
    model: mujoco.MjModel, data: mujoco.MjData, hfield: int, geom: int, contacts: list[mujoco.MjContact]
) -> None:
    """Correct the contacts of a geom with a height field in place; the first is the deepest.

    If the centre of a sphere, or of the end of a capsule, is below the surface, its contacts become those of such
    spheres with the triangles under them. Otherwise the deepest contact, with the nearest point of the surface, stays.
    Others stay if they are with the face of a triangle, not with its edge; a sphere keeps one for each direction.
    """
    kind, (radius, half, _) = model.geom_type[geom], model.geom_size[geom]
    ends = {_SPHERE: [0.0], _CAPSULE: [-half, half]}.get(int(kind), [])
    spheres = [data.geom_xpos[geom] + end * data.geom_xmat[geom].reshape(3, 3)[:, 2] for end in ends]
    under = [_surface(model, data, hfield, centre) for centre in spheres]
    if any(depth < 0.0 for depth, _ in under):
        distances = [depth * normal[2] - radius for depth, normal in under]
        touching = [i for i in np.argsort(distances) if distances[i] < 0.0]
        for contact, i in zip(contacts, touching, strict=False):
            normal, tangent = under[i][1], np.cross(under[i][1], [1.0, 0.0, 0.0])
            tangent /= np.linalg.norm(tangent)
            contact.dist, contact.frame = distances[i], np.concatenate([normal, tangent, np.cross(normal, tangent)])
            contact.pos = spheres[i] - (radius + 0.5 * distances[i]) * normal
        for contact in contacts[len(touching) :]:
            contact.exclude = 1
        return
    kept = [contacts[0].frame[:3]]
    for contact in contacts[1:]:
        normal = contact.frame[:3]
        on_surface = contact.pos - 0.5 * contact.dist * normal  # contacts are half-way between the surfaces
        _, face = _surface(model, data, hfield, on_surface)
        if normal @ face < SAME_FACE or (kind == _SPHERE and any(normal @ other > SAME_FACE for other in kept)):
            contact.exclude = 1
        else:
            kept.append(normal)


def _surface(model: mujoco.MjModel, data: mujoco.MjData, hfield: int, point: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the height of a point above the surface [m] and the normal there; infinite and upwards outside the map."""
    normal, above = np.array([0.0, 0.0, 1.0]), point + np.array([0.0, 0.0, _ABOVE])
    depth = mujoco.mj_rayHfield(model, data, hfield, above, np.array([0.0, 0.0, -1.0]), normal)
    return (depth - _ABOVE, normal) if depth >= 0.0 else (math.inf, np.array([0.0, 0.0, 1.0]))
