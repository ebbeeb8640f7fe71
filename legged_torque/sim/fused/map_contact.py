"""Contacts with a height map: each has a normal of its own, and a sphere may have two."""

import warp as wp

from legged_torque.sim.fused.contact import Contact, contact_normal, half_size, make_contact
from legged_torque.sim.fused.math import quat_to_matrix
from legged_torque.sim.fused.smooth import Poses
from legged_torque.sim.fused.surface import Surface, is_clear, make_surface, touch_map
from legged_torque.sim.fused.tables import Tables, of_world
from legged_torque.sim.fused.types import vec4
from legged_torque.sim.height_map import HeightMap

MAX_TOUCHES = 2
"""Most contacts of a sphere with a height map."""


@wp.struct
class Ground:
    """A height map, and scratch for the normals of the contacts with it."""

    surface: Surface
    normals: wp.array(dtype=wp.vec3)


def make_ground(height_map: HeightMap, room: int) -> Ground:
    """Return a height map on the current device, with room for some contacts."""
    ground = Ground()
    ground.surface = make_surface(height_map)
    ground.normals = wp.empty(room, dtype=wp.vec3)
    return ground


@wp.struct
class MapContacts:
    """The contacts with a height map; each branch of each world has room for two per point."""

    found: wp.array(dtype=Contact)
    residual: wp.array(dtype=vec4)  # the next three as in Contacts
    pushing: wp.array(dtype=vec4)
    change: wp.array(dtype=vec4)
    ground: Ground


@wp.func
def map_contacts(
    tables: Tables,
    world: int,
    ground: Ground,
    found: wp.array(dtype=Contact),
    residual: wp.array(dtype=vec4),
    pushing: wp.array(dtype=vec4),
    change: wp.array(dtype=vec4),
) -> MapContacts:
    """Return where a kernel keeps the contacts with a height map; the floor has no pose."""
    return MapContacts(found, residual, pushing, change, ground)


@wp.func  # an overload
def contact_normal(contacts: MapContacts, k: int) -> wp.vec3:  # type: ignore[no-redef]  # noqa: F811
    """Return the unit normal of the ground at a contact; the solver takes this or the plane's by its contacts' type."""
    return contacts.ground.normals[k]


@wp.func
def find_map_contacts(
    tables: Tables, world: int, b: int, origin: wp.vec3, poses: Poses, contacts: MapContacts, first: int
) -> int:
    """Write the contacts of a branch with the height map from index ``first`` on and return how many there are.

    Of a box all corners touch: without those above its centre, which MuJoCo leaves out on a plane, rough ground would
    hold a box that is more than half in it.
    """
    surface = contacts.ground.surface
    points = tables.point_count[b]
    count = int(0)
    point = int(0)
    geom = int(-1)
    depth = int(0)
    radius = float(0.0)
    half = wp.vec3()
    middle = wp.vec3()
    centre = wp.vec3()
    turn = wp.mat33()
    while point < points:
        is_near = bool(False)
        while point < points and not is_near:  # all threads find a point before they look at the ground together
            if tables.point_geom[b, point] != geom:
                geom = tables.point_geom[b, point]
                depth = tables.point_depth[b, point]
                half = half_size(tables, world, geom)
                radius = tables.point_radius[b, point] * of_world(tables.geom_size, world, geom)[0]
                middle = poses[depth].pos + poses[depth].rot * of_world(tables.geom_pos, world, geom)
                turn = poses[depth].rot * quat_to_matrix(of_world(tables.geom_quat, world, geom))
            if origin[2] + middle[2] > surface.top + wp.length(half) + radius:
                point = tables.point_next[b, point]  # the geom is above all of the map
            else:
                centre = middle + turn * wp.cw_mul(tables.point_offset[b, point], half)
                is_near = not is_clear(surface, origin + centre, radius)
                point += 1
        if is_near:
            touch = touch_map(surface, origin + centre, radius)
            for i in range(touch.count):
                normal = wp.where(i == 0, touch.first, touch.second)
                dist = wp.where(i == 0, touch.dist[0], touch.dist[1])
                contacts.ground.normals[first + count] = normal
                contacts.found[first + count] = make_contact(
                    tables, world, geom, depth, poses[depth], turn, centre, radius, dist, normal
                )
                count += 1
    return count
