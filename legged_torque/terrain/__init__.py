"""The ground: what rewards, resets, evaluation and viewers know of it."""

from typing import Any

from legged_torque.terrain.plane import Plane
from legged_torque.terrain.rough import RoughGround
from legged_torque.terrain.terrain import Terrain
from legged_torque.utils.errors import unknown_name

TERRAINS: dict[str, type[Terrain]] = {"plane": Plane, "heightfield": RoughGround}
"""Kinds of ground, by ``terrain.mesh_type``."""


def make_terrain(settings: Any, num_envs: int, device: str) -> Terrain:
    """Return the ground that a section ``terrain`` of settings asks for; a UserError if there is no such ground."""
    if settings.mesh_type not in TERRAINS:
        raise unknown_name("terrain.mesh_type", settings.mesh_type, TERRAINS)
    return TERRAINS[settings.mesh_type].build(settings, num_envs, device)
