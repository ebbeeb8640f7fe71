"""Steps of plain MuJoCo in which contacts with height fields are those of their surfaces, as in training.

In MuJoCo, a geom touches every triangle of a height field that it overlaps, each as if it were a column of its own.
Feet that sink into level ground by a centimetre also touch edges of the columns around them, with normals tilted by up
to 60 degrees; where they sink deeper, the shortest way out is sideways. A trained A1 hardly walks there. Corrected
contacts follow the same law as training's, so on rough ground they are no independent evidence.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

SAME_FACE = math.cos(math.radians(2.6))  # least cosine between normals of one face, as in training
_ABOVE = 10.0  # height over a place from which rays look down on it [m]


def step(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Do what ``mj_step`` does, with corrected contacts of height fields; RK4 becomes Euler where there are any."""
    if not model.nhfield:
        mujoco.mj_step(model, data)
        return
    mujoco.mj_step1(model, data)
    if correct_contacts(model, data):
        mujoco.mj_makeConstraint(model, data)
        mujoco.mj_island(model, data)
        mujoco.mj_projectConstraint(model, data)
        mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_step2(model, data)


def correct_contacts(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    """Correct the contacts of height fields in place, and return whether there are any."""
    by_geoms: dict[tuple[int, int], list[mujoco.MjContact]] = {}
    for contact in data.contact:
        hfield, geom = contact.geom.tolist()  # in the order of their types
        if model.geom_type[hfield] == mujoco.mjtGeom.mjGEOM_HFIELD:
            by_geoms.setdefault((hfield, geom), []).append(contact)
    for (hfield, geom), contacts in by_geoms.items():
        contacts.sort(key=lambda contact: contact.dist)
        spheres = _spheres(model, data, geom)
        under = [_surface(model, data, hfield, centre) for centre in spheres]
        if any(depth < 0.0 for depth, _ in under):
            _push_out(contacts, spheres, under, model.geom_size[geom, 0])
        else:
            _drop_ghosts(model, data, hfield, contacts)
    return bool(by_geoms)


def _push_out(
    contacts: list[mujoco.MjContact], spheres: np.ndarray, under: list[tuple[float, np.ndarray]], radius: float
) -> None:
    """Replace the contacts of spheres, one of which has its centre below the surface, by those with its triangles."""
    distances = [depth * normal[2] - radius for depth, normal in under]
    touching = [i for i in np.argsort(distances) if distances[i] < 0.0]
    for contact, i in zip(contacts, touching, strict=False):
        normal, tangent = under[i][1], np.cross(under[i][1], [1.0, 0.0, 0.0])
        tangent /= np.linalg.norm(tangent)
        contact.dist, contact.frame = distances[i], np.concatenate([normal, tangent, np.cross(normal, tangent)])
        contact.pos = spheres[i] - (radius + 0.5 * distances[i]) * normal
    for contact in contacts[len(touching) :]:
        contact.exclude = 1


def _drop_ghosts(model: mujoco.MjModel, data: mujoco.MjData, hfield: int, contacts: list[mujoco.MjContact]) -> None:
    """Exclude contacts of a geom that the whole surface does not have; the first is the deepest.

    The deepest is with the nearest point of the surface, and stays. Others stay if they are with the face of a
    triangle, not with its edge; a sphere keeps one for each direction.
    """
    deepest, *others = contacts
    kept = [deepest.frame[:3]]
    is_sphere = model.geom_type[deepest.geom[1]] == mujoco.mjtGeom.mjGEOM_SPHERE
    for contact in others:
        normal = contact.frame[:3]
        on_surface = contact.pos - 0.5 * contact.dist * normal  # contacts are half-way between the surfaces
        _, face = _surface(model, data, hfield, on_surface)
        if normal @ face < SAME_FACE or (is_sphere and any(normal @ other > SAME_FACE for other in kept)):
            contact.exclude = 1
        else:
            kept.append(normal)


def _spheres(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Return the centres of the spheres at the ends of a sphere or capsule; none for other geoms. Shape: (n, 3) [m]."""
    kind, centre = model.geom_type[geom], data.geom_xpos[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return centre[np.newaxis]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        half = model.geom_size[geom, 1] * data.geom_xmat[geom].reshape(3, 3)[:, 2]
        return np.stack([centre - half, centre + half])
    return np.empty((0, 3))


def _surface(model: mujoco.MjModel, data: mujoco.MjData, hfield: int, point: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the height of a point above the surface [m] and the normal there; infinite and upwards outside the map."""
    normal, above = np.array([0.0, 0.0, 1.0]), point + np.array([0.0, 0.0, _ABOVE])
    depth = mujoco.mj_rayHfield(model, data, hfield, above, np.array([0.0, 0.0, -1.0]), normal)
    return (depth - _ABOVE, normal) if depth >= 0.0 else (math.inf, np.array([0.0, 0.0, 1.0]))


STEPS = {"training": step, "mujoco": mujoco.mj_step}
NOTES = {
    "training": "contacts with height fields are corrected to those of training, so they are not tested independently; "
    "--contacts=mujoco leaves MuJoCo's",
    "mujoco": "contacts with height fields are MuJoCo's own: feet also touch edges inside of level ground",
}
"""Physics steps by whose contacts act, and what to say of them."""
