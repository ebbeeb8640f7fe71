"""Collision with a plane: where a robot touches the floor."""

import warp as wp

from legged_torque.sim.fused.constraint import MIN_VALUE, Contact, contact_params, with_rows
from legged_torque.sim.fused.math import quat_to_matrix
from legged_torque.sim.fused.model import Model, of_world
from legged_torque.sim.fused.smooth import Pose, Poses
from legged_torque.sim.fused.types import vec4

CAPSULE = wp.constant(3)
CYLINDER = wp.constant(5)
BOX = wp.constant(6)
"""MuJoCo's mjGEOM_CAPSULE, mjGEOM_CYLINDER and mjGEOM_BOX."""
UPRIGHT = wp.constant(1.0e-6)
"""A cylinder whose axis leans less than this [rad] from the normal has no lowest direction across it.

MuJoCo turns the three contacts of a flat end to the direction of the lean, however small. In float32 this direction is
rounding below some 1e-5 rad: the contacts are then elsewhere on the rim than MuJoCo's, as deep in the ground.
"""
MAX_CORNERS = wp.constant(4)
"""Most contacts of a box with a plane: MuJoCo takes the first four corners below its centre that touch."""


@wp.struct
class PlaneContacts:
    """The contacts with the floor; each branch of each world has room for as many as it has points."""

    found: wp.array(dtype=Contact)
    residual: wp.array(dtype=vec4)  # J a - a_ref of the four rows
    pushing: wp.array(dtype=vec4)  # 1 for the rows that push, else 0
    change: wp.array(dtype=vec4)  # of the residual per unit of the solver's step
    normal: wp.vec3  # the floor's


@wp.func
def contact_normal(contacts: PlaneContacts, k: int) -> wp.vec3:
    """Return the unit normal of the ground at a contact: the floor's. ``collision_map`` has an overload for maps."""
    return contacts.normal


@wp.func
def place_plane(model: Model, ground: int, world: int, contacts: PlaneContacts) -> PlaneContacts:
    """Return the contacts with the normal of the model's floor."""
    rot = quat_to_matrix(of_world(model.geom_quat, world, model.floor))
    contacts.normal = wp.vec3(rot[0, 2], rot[1, 2], rot[2, 2])
    return contacts


@wp.struct
class Point:
    """A point of a branch that may touch the ground."""

    geom: wp.int32
    depth: wp.int32  # of its body
    middle: wp.vec3  # of the geom, from the trunk's origin, in world axes [m]
    turn: wp.mat33  # from the geom's axes to the world's
    half: wp.vec3  # half sizes of the geom
    centre: wp.vec3  # where the point is, from the trunk's origin, in world axes [m]
    radius: wp.float32  # how thick the geom is around it [m]


@wp.func
def contact_tangent(normal: wp.vec3, axis: wp.vec3, is_capsule: bool) -> wp.vec3:
    """Return the first direction of friction: along a capsule, else MuJoCo's choice for a normal."""
    along = axis - normal * wp.dot(normal, axis)
    length = wp.length(along)
    tangent = along / wp.max(length, MIN_VALUE)
    if not is_capsule or length < 1.0e-6:
        tangent = wp.vec3(0.0, 1.0, 0.0)
        if wp.abs(normal[1]) >= 0.5:
            tangent = wp.vec3(0.0, 0.0, 1.0)
        tangent = wp.normalize(tangent - normal * wp.dot(normal, tangent))
    return tangent


@wp.func
def make_contact(model: Model, world: int, point: Point, pose: Pose, dist: float, normal: wp.vec3) -> Contact:
    """Return the contact of a sphere around a point of a body, at a distance from the ground that is negative."""
    contact = Contact()
    contact.pos = point.centre - (point.radius + 0.5 * dist) * normal
    contact.depth = point.depth
    contact.sensor = model.geom_sensor[point.geom]
    is_capsule = model.geom_type[point.geom] == CAPSULE
    axis = wp.vec3(point.turn[0, 2], point.turn[1, 2], point.turn[2, 2])
    contact.tangent = contact_tangent(normal, axis, is_capsule)
    velocity = pose.lin_vel + wp.cross(pose.ang_vel, contact.pos)
    params = contact_params(model, world, model.floor, point.geom)
    return with_rows(model, world, wp.vec2i(model.floor, point.geom), params, dist, velocity, normal, contact)


@wp.func
def half_size(model: Model, world: int, geom: int, cylinders: bool) -> wp.vec3:
    """Return the half sizes of a geom, the units of its points; ``cylinders``: whether it may be one."""
    size = of_world(model.geom_size, world, geom)
    half = size
    if model.geom_type[geom] == CAPSULE:
        half = wp.vec3(0.0, 0.0, size[1])
    if cylinders and model.geom_type[geom] == CYLINDER:
        half = wp.vec3(size[0], size[0], size[1])
    return half


@wp.func
def turn_cylinder(turn: wp.mat33, normal: wp.vec3) -> wp.mat33:
    """Return a cylinder's orientation, turned about its axis so that its points are MuJoCo's.

    The first axis becomes the one that leads down, against the normal, and the third one leads to the lower end.
    """
    axis = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
    if wp.dot(axis, normal) > 0.0:
        axis = -axis
    down = axis * wp.dot(axis, normal) - normal
    length = wp.length(down)
    first = wp.vec3(turn[0, 0], turn[1, 0], turn[2, 0])
    if length > UPRIGHT:
        first = down / length
    return wp.matrix_from_cols(first, wp.cross(axis, first), axis)


@wp.func
def find_contacts(
    model: Model,
    world: int,
    b: int,
    origin: wp.vec3,
    poses: Poses,
    contacts: PlaneContacts,
    first: int,
    cylinders: bool,
) -> int:
    """Write the contacts of a branch with the floor from index ``first`` on and return how many there are.

    ``cylinders``: whether the robot has any, a constant, which keeps their code out of kernels for others.
    """
    normal = contacts.normal
    count = int(0)
    last_geom = int(-1)
    in_geom = int(0)
    height = origin - of_world(model.geom_pos, world, model.floor)
    index = int(0)
    point = Point()
    while index < model.point_count[b]:
        point.geom = model.point_geom[b, index]
        point.depth = model.point_depth[b, index]
        point.half = half_size(model, world, point.geom, cylinders)
        point.radius = model.point_radius[b, index] * of_world(model.geom_size, world, point.geom)[0]
        pose = poses[point.depth]
        point.middle = pose.pos + pose.rot * of_world(model.geom_pos, world, point.geom)
        if wp.dot(height + point.middle, normal) > wp.length(point.half) + point.radius:
            index = model.point_next[b, index]  # nothing of the geom reaches the floor
            continue
        point.turn = pose.rot * quat_to_matrix(of_world(model.geom_quat, world, point.geom))
        if cylinders and model.geom_type[point.geom] == CYLINDER:
            point.turn = turn_cylinder(point.turn, normal)
        arm = point.turn * wp.cw_mul(model.point_offset[b, index], point.half)
        point.centre = point.middle + arm
        dist = wp.dot(height + point.centre, normal) - point.radius
        if point.geom != last_geom:
            last_geom = point.geom
            in_geom = 0
        if model.geom_type[point.geom] == BOX and (wp.dot(arm, normal) > 0.0 or in_geom == MAX_CORNERS):
            dist = 0.0
        if dist < 0.0:
            in_geom += 1
            contacts.found[first + count] = make_contact(model, world, point, pose, dist, normal)
            count += 1
        index += 1
    return count
