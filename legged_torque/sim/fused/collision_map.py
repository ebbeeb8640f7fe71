"""Collision with a height map: each contact has a normal of its own, and a sphere may have two."""

import warp as wp

from legged_torque.sim.fused.collision import CYLINDER, Point, contact_normal, half_size, make_contact
from legged_torque.sim.fused.collision_parts import lowest_of_capsule, reach_along, touch_part
from legged_torque.sim.fused.constraint import Contact
from legged_torque.sim.fused.math import quat_to_matrix
from legged_torque.sim.fused.model import Model, of_world
from legged_torque.sim.fused.smooth import Pose, Poses
from legged_torque.sim.fused.surface import SphereContacts, Surface, is_clear, sphere_map
from legged_torque.sim.fused.types import vec4

MAX_MAP_CONTACTS = 2
"""Most contacts of a sphere with a height map."""

MIN_EXCESS = wp.constant(1.0e-4)
"""Part of a geom that is not this much deeper [m] than its corners or ends is on the same plane as these."""


@wp.struct
class MapContacts:
    """The contacts with a height map; each branch of each world has room for two per point."""

    found: wp.array(dtype=Contact)
    residual: wp.array(dtype=vec4)  # J a - a_ref of the four rows
    pushing: wp.array(dtype=vec4)  # 1 for the rows that push, else 0
    change: wp.array(dtype=vec4)  # of the residual per unit of the solver's step
    normal: wp.array(dtype=wp.vec3)
    surface: Surface  # of the map


@wp.func
def place_map(model: Model, ground: Surface, world: int, contacts: MapContacts) -> MapContacts:
    """Return the contacts with the height map."""
    contacts.surface = ground
    return contacts


@wp.func  # an overload, which the solver takes for contacts of this type
def contact_normal(contacts: MapContacts, k: int) -> wp.vec3:  # type: ignore[no-redef]  # noqa: F811
    """Return the unit normal of the ground at a contact."""
    return contacts.normal[k]


@wp.func
def load_geom(model: Model, world: int, b: int, index: int, pose: Pose, cylinders: bool) -> Point:
    """Return a point of a branch with everything that it shares with the others of its geom."""
    out = Point()
    out.geom = model.point_geom[b, index]
    out.depth = model.point_depth[b, index]
    out.half = half_size(model, world, out.geom, cylinders)
    out.radius = model.point_radius[b, index] * of_world(model.geom_size, world, out.geom)[0]
    out.middle = pose.pos + pose.rot * of_world(model.geom_pos, world, out.geom)
    out.turn = pose.rot * quat_to_matrix(of_world(model.geom_quat, world, out.geom))
    return out


@wp.func
def is_geom_clear(
    model: Model, b: int, index: int, origin: wp.vec3, point: Point, surface: Surface, cylinders: bool
) -> bool:
    """Return whether the whole geom of a point is known to be above the ground."""
    half = wp.cw_mul(model.point_offset[b, index], point.half)
    if cylinders and model.geom_type[point.geom] == CYLINDER:
        half = point.half  # points around its ends are not corners of a box
    return is_part_clear(surface, origin + point.middle, half, point)


@wp.func
def is_part_clear(surface: Surface, middle: wp.vec3, half: wp.vec3, point: Point) -> bool:
    """Return whether a part of a point's geom, by its middle and half sizes, is known to be above the ground."""
    lowest = middle[2] - reach_along(point.turn, half, 2) - point.radius
    reach = wp.max(reach_along(point.turn, half, 0), reach_along(point.turn, half, 1))
    return is_clear(surface, middle, lowest, reach + point.radius)


@wp.func
def find_map_contacts(
    model: Model, world: int, b: int, origin: wp.vec3, poses: Poses, contacts: MapContacts, first: int, cylinders: bool
) -> int:
    """Write the contacts of a branch with the height map from index ``first`` on and return how many there are.

    All corners of a box can touch. MuJoCo leaves out those above its centre on a plane, but on rough ground these hold
    a box that is more than half in it. The inner loop lets all threads of a group find a point before they look at the
    ground together, which takes much longer.
    """
    surface = contacts.surface
    count = int(0)
    index = int(0)
    point = Point()
    point.geom = -1
    part = wp.vec3()
    is_part = bool(False)
    parts = int(0)  # the first of the geom
    deepest = float(0.0)  # of the geom's corners or ends
    is_above = bool(False)
    while index < model.point_count[b]:
        is_near = bool(False)
        while index < model.point_count[b] and not is_near:
            if model.point_geom[b, index] != point.geom:
                point = load_geom(model, world, b, index, poses[model.point_depth[b, index]], cylinders)
                is_above = is_geom_clear(model, b, index, origin, point, surface, cylinders)
                parts = model.point_parts[b, index]
                deepest = 0.0
            if is_above:
                index = model.point_next[b, index]
            else:
                point.centre = point.middle + point.turn * wp.cw_mul(model.point_offset[b, index], point.half)
                is_part = index >= parts
                if is_part:
                    part = wp.cw_mul(model.point_half[b, index], point.half)
                    is_near = not is_part_clear(surface, origin + point.centre, part, point)
                    if is_near and point.radius > 0.0:
                        is_between, lowest = lowest_of_capsule(surface, origin, point, part)
                        is_near = is_between
                        point.centre = lowest
                else:
                    centre = origin + point.centre
                    is_near = not is_clear(surface, centre, centre[2] - point.radius, point.radius)
                index += 1
        if is_near:
            touch = SphereContacts()
            if is_part and point.radius == 0.0:
                touch, place = touch_part(surface, origin, point, part)
                point.centre = place
            else:
                touch = sphere_map(surface, origin + point.centre, point.radius)
            for i in range(touch.count):
                normal = wp.where(i == 0, touch.first, touch.second)
                dist = wp.where(i == 0, touch.dist[0], touch.dist[1])
                if is_part:
                    dist = dist + deepest
                else:
                    deepest = wp.max(deepest, -dist)
                if not is_part or dist < -MIN_EXCESS:
                    contacts.normal[first + count] = normal
                    pose = poses[point.depth]
                    contacts.found[first + count] = make_contact(model, world, point, pose, dist, normal)
                    count += 1
    return count
