"""Contacts with a height map: each has a normal of its own, and a sphere may have two."""

import warp as wp

from legged_torque.sim.fused.contact import CYLINDER, Contact, contact_normal, half_size, make_contact
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


@wp.struct
class Point:
    """A point of a branch that may touch the ground."""

    geom: wp.int32
    depth: wp.int32  # of its body
    middle: wp.vec3  # of the geom, from the trunk's origin, in world axes [m]
    turn: wp.mat33  # from the geom's axes to the world's
    half: wp.vec3  # see half_size
    centre: wp.vec3  # where the point is, as the middle
    radius: wp.float32  # how thick the geom is around it [m]
    is_clear: wp.bool  # whether the whole geom is known to be above the ground
    is_near: wp.bool  # whether the ground may be so near


@wp.func
def see_geom(
    tables: Tables, world: int, b: int, index: int, origin: wp.vec3, poses: Poses, surface: Surface, cylinders: bool
) -> Point:
    """Return a point of a branch with all that it shares with the others of its geom."""
    out = Point()
    out.geom = tables.point_geom[b, index]
    out.depth = tables.point_depth[b, index]
    out.half = half_size(tables, world, out.geom, cylinders)
    out.radius = tables.point_radius[b, index] * of_world(tables.geom_size, world, out.geom)[0]
    pose = poses[out.depth]
    out.middle = pose.pos + pose.rot * of_world(tables.geom_pos, world, out.geom)
    out.turn = pose.rot * quat_to_matrix(of_world(tables.geom_quat, world, out.geom))
    half = wp.cw_mul(tables.point_offset[b, index], out.half)
    if cylinders and tables.geom_type[out.geom] == CYLINDER:
        half = out.half  # points around its ends are not corners of a box
    middle = origin + out.middle
    drop = wp.abs(out.turn[2, 0] * half[0]) + wp.abs(out.turn[2, 1] * half[1]) + wp.abs(out.turn[2, 2] * half[2])
    out.is_clear = is_clear(surface, middle, middle[2] - drop - out.radius, wp.length(half) + out.radius)
    return out


@wp.func
def find_map_contacts(
    tables: Tables,
    world: int,
    b: int,
    origin: wp.vec3,
    poses: Poses,
    contacts: MapContacts,
    first: int,
    cylinders: bool,
) -> int:
    """Write the contacts of a branch with the height map from index ``first`` on and return how many there are.

    Of a box all corners touch: without those above its centre, which MuJoCo leaves out on a plane, rough ground would
    hold a box that is more than half in it. The inner loop lets all threads of a group find a point before they look
    at the ground together, which takes much longer.
    """
    surface = contacts.ground.surface
    count = int(0)
    index = int(0)
    point = Point()
    point.geom = -1
    while index < tables.point_count[b]:
        point.is_near = False
        while index < tables.point_count[b] and not point.is_near:
            if tables.point_geom[b, index] != point.geom:
                point = see_geom(tables, world, b, index, origin, poses, surface, cylinders)
            if point.is_clear:
                index = tables.point_next[b, index]
            else:
                point.centre = point.middle + point.turn * wp.cw_mul(tables.point_offset[b, index], point.half)
                centre = origin + point.centre
                point.is_near = not is_clear(surface, centre, centre[2] - point.radius, point.radius)
                index += 1
        if point.is_near:
            touch = touch_map(surface, origin + point.centre, point.radius)
            for i in range(touch.count):
                normal = wp.where(i == 0, touch.first, touch.second)
                dist = wp.where(i == 0, touch.dist[0], touch.dist[1])
                contacts.ground.normals[first + count] = normal
                contacts.found[first + count] = make_contact(
                    tables,
                    world,
                    point.geom,
                    point.depth,
                    poses[point.depth],
                    point.turn,
                    point.centre,
                    point.radius,
                    dist,
                    normal,
                )
                count += 1
    return count
