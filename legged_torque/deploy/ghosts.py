"""Steps of plain MuJoCo on a height field without ghost contacts.

MuJoCo lets a geom touch every triangle of a height field that it overlaps, each as if it were alone. On level ground, a
foot that sinks in by a centimetre then also touches edges of the triangles around it, with normals that are tilted by
up to 60 degrees: a trained A1 hardly walks there. The surface has no such edges, so those contacts are taken out.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

ALIKE = math.cos(math.radians(2.6))  # cosine of the angle up to which two normals are of one face, as in training


def step(model: mujoco.MjModel, data: mujoco.MjData, hfield: int) -> None:
    """Do what ``mj_step`` does, with the contacts of the geom ``hfield`` that its surface has."""
    mujoco.mj_step1(model, data)
    if drop_ghosts(model, data, hfield):
        mujoco.mj_makeConstraint(model, data)
        mujoco.mj_island(model, data)
        mujoco.mj_projectConstraint(model, data)
        mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_step2(model, data)


def drop_ghosts(model: mujoco.MjModel, data: mujoco.MjData, hfield: int) -> bool:
    """Exclude contacts of the geom ``hfield`` that its surface does not have; return whether there were any.

    Of each geom's contacts the deepest stays, which is with the nearest point of the whole surface. Others stay where
    they are with the face of a triangle, not with its edge; of a sphere's, one for each direction.
    """
    contacts = [contact for contact in data.contact if hfield in contact.geom]
    kept: dict[int, list[np.ndarray]] = {}
    for contact in sorted(contacts, key=lambda contact: contact.dist):
        is_first = contact.geom[0] == hfield
        geom, normal = int(contact.geom[int(is_first)]), contact.frame[:3] * (1.0 if is_first else -1.0)
        others = kept.setdefault(geom, [])
        is_sphere = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE
        is_known = is_sphere and any(normal @ other > ALIKE for other in others)
        if others and (is_known or normal @ _face_normal(model, data, hfield, contact, normal) < ALIKE):
            contact.exclude = 1
        else:
            others.append(normal.copy())
    return sum(map(len, kept.values())) < len(contacts)


def _face_normal(
    model: mujoco.MjModel, data: mujoco.MjData, hfield: int, contact: mujoco.MjContact, normal: np.ndarray
) -> np.ndarray:
    """Return the normal of the triangle on which a contact is. Shape: (3,)."""
    on_surface = contact.pos - 0.5 * contact.dist * normal  # contacts are half-way between the surfaces
    result = np.zeros(3)
    above, down = on_surface + np.array([0.0, 0.0, 10.0]), np.array([0.0, 0.0, -1.0])
    mujoco.mj_rayHfield(model, data, hfield, above, down, result)
    return result
