"""The ground: what rewards, resets, evaluation and viewers know of it.

Classes of grounds, which need torch, are named, not imported: maps are also made where there is none.
"""

from __future__ import annotations

import pkgutil
from typing import TYPE_CHECKING, Any

from legged_torque.utils.errors import unknown_name

if TYPE_CHECKING:
    from legged_torque.terrain.terrain import Terrain

TERRAINS: dict[str, type[Terrain] | str] = {
    "plane": "legged_torque.terrain.terrain:Plane",
    "heightfield": "legged_torque.terrain.rough:RoughGround",
}
"""Kinds of ground, by ``terrain.mesh_type``; a class, or its name, ``"module:Class"``."""


def make_terrain(settings: Any, num_envs: int, device: str) -> Terrain:
    """Return the ground that a section ``terrain`` of settings asks for; a UserError if there is no such ground."""
    if settings.mesh_type not in TERRAINS:
        raise unknown_name("terrain.mesh_type", settings.mesh_type, TERRAINS)
    ground = TERRAINS[settings.mesh_type]
    ground_class: type[Terrain] = pkgutil.resolve_name(ground) if isinstance(ground, str) else ground
    return ground_class.build(settings, num_envs, device)
