"""The ground: what rewards, resets, evaluation and viewers know of it."""

from legged_torque.terrain.plane import Plane
from legged_torque.terrain.terrain import Terrain
from legged_torque.utils.errors import unknown_name

TERRAINS: dict[str, type[Terrain]] = {"plane": Plane}  # kinds of ground, by ``terrain.mesh_type``


def make_terrain(mesh_type: str) -> Terrain:
    """Return the ground that ``terrain.mesh_type`` asks for; a UserError if there is no such ground."""
    if mesh_type not in TERRAINS:
        raise unknown_name("terrain.mesh_type", mesh_type, TERRAINS)
    return TERRAINS[mesh_type]()
