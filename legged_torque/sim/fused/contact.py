"""Contacts with the floor: where a robot touches it, and the constraint rows and forces of a contact."""

import warp as wp

from legged_torque.sim.fused.constraint import MIN_VALUE, constraint_mass, reference_dynamics
from legged_torque.sim.fused.math import quat_to_matrix
from legged_torque.sim.fused.smooth import Pose, Poses
from legged_torque.sim.fused.tables import Tables, of_world
from legged_torque.sim.fused.types import vec4

MIN_FRICTION = wp.constant(1.0e-5)
"""MuJoCo's mjMINMU."""
MAX_CONTACT_MASS = wp.constant(4.0e4)
"""Most mass of a contact's rows, times the inverse weight of its body. Contacts get stiffer with less friction and with
impratio, without limit, while float32 loses the solution: at this stiffness, rounding
errors reach about 1e-3 m/s."""
STICKING_ACCELERATION = wp.constant(10.0)
PARTING_ACCELERATION = wp.constant(40.0)
"""Contacts whose references ask for more [m/s^2] along a tangent are expected to slide, into the floor to part. This
changes how long the solver takes, no result."""
INFINITY = wp.constant(1.0e30)
CAPSULE = wp.constant(3)
CYLINDER = wp.constant(5)
BOX = wp.constant(6)
"""MuJoCo's mjGEOM_CAPSULE, mjGEOM_CYLINDER and mjGEOM_BOX."""
UPRIGHT = wp.constant(1.0e-6)
"""A cylinder whose axis leans less than this [rad] from the normal has no lowest direction across it."""
MAX_CORNERS = wp.constant(4)
"""Most contacts of a box with a plane: MuJoCo takes the first four corners below its centre that touch."""


@wp.struct
class Contact:
    """A point of the robot that touches the floor."""

    pos: wp.vec3  # from the trunk's origin, in world axes [m]
    tangent: wp.vec3  # first direction of friction; the second is normal x tangent
    depth: wp.int32  # of its body; 0 is the trunk
    sensor: wp.int32  # address of its geom's contact sensor, -1 without
    friction: wp.float32
    mass: wp.float32  # D of its four rows
    reference: vec4  # a_ref of its four rows


@wp.struct
class Contacts:
    """The contacts with the floor; each branch of each world has room for as many as it has points."""

    found: wp.array(dtype=Contact)
    residual: wp.array(dtype=vec4)  # J a - a_ref of the four rows
    pushing: wp.array(dtype=vec4)  # 1 for the rows that push, else 0
    change: wp.array(dtype=vec4)  # of the residual per unit of the solver's step
    normal: wp.vec3  # the floor's


@wp.func
def contact_normal(contacts: Contacts, k: int) -> wp.vec3:
    """Return the unit normal of the ground at a contact: the floor's; see ``map_contact`` for a height map's."""
    return contacts.normal


@wp.func
def floor_normal(tables: Tables, world: int) -> wp.vec3:
    """Return the unit normal of the floor."""
    rot = quat_to_matrix(of_world(tables.geom_quat, world, tables.floor))
    return wp.vec3(rot[0, 2], rot[1, 2], rot[2, 2])


@wp.func
def plane_contacts(
    tables: Tables,
    world: int,
    ground: int,
    found: wp.array(dtype=Contact),
    residual: wp.array(dtype=vec4),
    pushing: wp.array(dtype=vec4),
    change: wp.array(dtype=vec4),
) -> Contacts:
    """Return where a kernel keeps the contacts with the model's floor, all that there is to the ``ground``."""
    return Contacts(found, residual, pushing, change, floor_normal(tables, world))


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
def set_contact_rows(
    tables: Tables, world: int, geom: int, dist: float, velocity: wp.vec3, normal: wp.vec3, contact: Contact
) -> Contact:
    """Return a contact with friction, mass and references of its rows, mixed from geom and floor as MuJoCo does."""
    floor = tables.floor
    weight_floor, weight_geom = of_world(tables.geom_solmix, world, floor), of_world(tables.geom_solmix, world, geom)
    mix = float(0.5)
    if weight_floor + weight_geom > 2.0 * MIN_VALUE:
        mix = weight_geom / (weight_floor + weight_geom)
    ref_floor, ref_geom = of_world(tables.geom_solref, world, floor), of_world(tables.geom_solref, world, geom)
    solref = wp.min(ref_floor, ref_geom)
    if ref_floor[0] > 0.0 and ref_geom[0] > 0.0:
        solref = mix * ref_geom + (1.0 - mix) * ref_floor
    friction_floor = of_world(tables.geom_friction, world, floor)[0]
    friction_geom = of_world(tables.geom_friction, world, geom)[0]
    friction = wp.max(friction_floor, friction_geom)
    if tables.geom_priority[geom] > tables.geom_priority[floor]:
        mix = 1.0
        solref = 1.0 * ref_geom
        friction = 1.0 * friction_geom
    if tables.geom_priority[geom] < tables.geom_priority[floor]:
        mix = 0.0
        solref = 1.0 * ref_floor
        friction = 1.0 * friction_floor
    solimp = mix * of_world(tables.geom_solimp, world, geom) + (1.0 - mix) * of_world(tables.geom_solimp, world, floor)
    params = reference_dynamics(solref, solimp, dist, tables.timestep)
    friction = wp.max(friction, MIN_FRICTION)
    invweight = of_world(tables.body_invweight0, world, tables.geom_bodyid[geom])[0]
    regularized = invweight * (1.0 + friction * friction) * 2.0 * friction * friction / tables.impratio
    contact.friction = friction
    contact.mass = wp.min(constraint_mass(regularized, params[2]), MAX_CONTACT_MASS / wp.max(invweight, MIN_VALUE))
    along = row_values(contact, normal, velocity)
    contact.reference = vec4(-params[0] * params[2] * dist) - params[1] * along
    return contact


@wp.func
def expected_rows(contact: Contact) -> vec4:
    """Return 1 for the rows that are expected to push, else 0: all where a contact sticks, else those against sliding.

    A row's reference is that of the normal and of the sideways velocity, which it shall stop. A contact that parts
    faster than its bodies can follow does not push.
    """
    reference = contact.reference
    along_normal = 0.25 * (reference[0] + reference[1] + reference[2] + reference[3])
    lowest = along_normal - STICKING_ACCELERATION * contact.friction
    if along_normal < -PARTING_ACCELERATION:
        lowest = INFINITY
    return vec4(
        wp.where(reference[0] < lowest, 0.0, 1.0),
        wp.where(reference[1] < lowest, 0.0, 1.0),
        wp.where(reference[2] < lowest, 0.0, 1.0),
        wp.where(reference[3] < lowest, 0.0, 1.0),
    )


@wp.func
def pushing_rows(x: vec4) -> vec4:
    """Return 1 for the rows that push, from the residuals J qacc - a_ref, else 0."""
    return vec4(
        wp.where(x[0] < 0.0, 1.0, 0.0),
        wp.where(x[1] < 0.0, 1.0, 0.0),
        wp.where(x[2] < 0.0, 1.0, 0.0),
        wp.where(x[3] < 0.0, 1.0, 0.0),
    )


@wp.func
def row_values(contact: Contact, normal: wp.vec3, motion: wp.vec3) -> vec4:
    """Return a motion of the contact point along its four rows: normal +- friction x each tangent."""
    up = wp.dot(normal, motion)
    first = contact.friction * wp.dot(contact.tangent, motion)
    second = contact.friction * wp.dot(wp.cross(normal, contact.tangent), motion)
    return vec4(up + first, up - first, up + second, up - second)


@wp.func
def contact_force(contact: Contact, normal: wp.vec3, x: vec4, pushing: vec4) -> wp.vec3:
    """Return the force on the robot in world axes [N] from the residuals J qacc - a_ref of its rows."""
    f = -contact.mass * wp.cw_mul(pushing, x)
    second = wp.cross(normal, contact.tangent)
    sideways = contact.friction * ((f[0] - f[1]) * contact.tangent + (f[2] - f[3]) * second)
    return (f[0] + f[1] + f[2] + f[3]) * normal + sideways


@wp.func
def contact_stiffness(contact: Contact, normal: wp.vec3, pushing: vec4) -> wp.mat33:
    """Return D times the sum over the pushing rows of direction x direction^T."""
    result = wp.mat33()
    first = contact.friction * contact.tangent
    second = contact.friction * wp.cross(normal, contact.tangent)
    for k in range(4):
        direction = normal
        if k == 0:
            direction = normal + first
        if k == 1:
            direction = normal - first
        if k == 2:
            direction = normal + second
        if k == 3:
            direction = normal - second
        result += contact.mass * pushing[k] * wp.outer(direction, direction)
    return result


@wp.func
def make_contact(
    tables: Tables,
    world: int,
    geom: int,
    depth: int,
    pose: Pose,
    turn: wp.mat33,
    centre: wp.vec3,
    radius: float,
    dist: float,
    normal: wp.vec3,
) -> Contact:
    """Return the contact of a sphere of a geom, at a distance from the ground that is negative."""
    contact = Contact()
    contact.pos = centre - (radius + 0.5 * dist) * normal
    contact.depth = depth
    contact.sensor = tables.geom_sensor[geom]
    is_capsule = tables.geom_type[geom] == CAPSULE
    contact.tangent = contact_tangent(normal, wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2]), is_capsule)
    velocity = pose.lin_vel + wp.cross(pose.ang_vel, contact.pos)
    return set_contact_rows(tables, world, geom, dist, velocity, normal, contact)


@wp.func
def half_size(tables: Tables, world: int, geom: int, cylinders: bool) -> wp.vec3:
    """Return the half sizes of a geom, in units of which its points stand; ``cylinders`` says if it may be one."""
    size = of_world(tables.geom_size, world, geom)
    half = size
    if tables.geom_type[geom] == CAPSULE:
        half = wp.vec3(0.0, 0.0, size[1])
    if cylinders and tables.geom_type[geom] == CYLINDER:
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
    tables: Tables, world: int, b: int, origin: wp.vec3, poses: Poses, contacts: Contacts, first: int, cylinders: bool
) -> int:
    """Write the contacts of a branch with the floor from index ``first`` on and return how many there are.

    ``cylinders`` says whether the robot has any: a constant, which keeps them out of kernels for others.
    """
    normal = contacts.normal
    count = int(0)
    last_geom = int(-1)
    in_geom = int(0)
    height = origin - of_world(tables.geom_pos, world, tables.floor)
    point = int(0)
    while point < tables.point_count[b]:
        geom = tables.point_geom[b, point]
        depth = tables.point_depth[b, point]
        half = half_size(tables, world, geom, cylinders)
        radius = tables.point_radius[b, point] * of_world(tables.geom_size, world, geom)[0]
        middle = poses[depth].pos + poses[depth].rot * of_world(tables.geom_pos, world, geom)
        if wp.dot(height + middle, normal) > wp.length(half) + radius:  # nothing of the geom reaches the floor
            point = tables.point_next[b, point]
            continue
        turn = poses[depth].rot * quat_to_matrix(of_world(tables.geom_quat, world, geom))
        if cylinders and tables.geom_type[geom] == CYLINDER:
            turn = turn_cylinder(turn, normal)
        arm = turn * wp.cw_mul(tables.point_offset[b, point], half)
        centre = middle + arm
        dist = wp.dot(height + centre, normal) - radius
        if geom != last_geom:
            last_geom = geom
            in_geom = 0
        if tables.geom_type[geom] == BOX and (wp.dot(arm, normal) > 0.0 or in_geom == MAX_CORNERS):
            dist = 0.0
        if dist < 0.0:
            in_geom += 1
            contacts.found[first + count] = make_contact(
                tables, world, geom, depth, poses[depth], turn, centre, radius, dist, normal
            )
            count += 1
        point += 1
    return count
