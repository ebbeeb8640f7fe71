"""Friction, limits and floor contacts of a branch: MuJoCo's constraint rows with their masses and references."""

import functools
from types import SimpleNamespace

import warp as wp

from legged_torque.sim.fused.dynamics import branch_dynamics
from legged_torque.sim.fused.math import quat_to_matrix, row, vec4, vec5
from legged_torque.sim.fused.robot import Robot

MIN_VALUE = wp.constant(1.0e-15)
MIN_IMPEDANCE = wp.constant(1.0e-4)
MAX_IMPEDANCE = wp.constant(0.9999)
MIN_FRICTION = wp.constant(1.0e-5)
"""MuJoCo's mjMINVAL, mjMINIMP, mjMAXIMP and mjMINMU."""
MAX_CONTACT_MASS = wp.constant(1.0e5)
"""Contacts get stiffer with less friction, without limit; above this, which one of 0.2 has with impratio 100, float32
loses the solution, while the softness that it stands for no longer matters."""
CAPSULE = wp.constant(3)
BOX = wp.constant(6)
"""MuJoCo's mjGEOM_CAPSULE and mjGEOM_BOX."""
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


@wp.func
def reference_dynamics(solref: wp.vec2, solimp: vec5, pos: float, timestep: float) -> wp.vec3:
    """Return stiffness, damping and impedance of a constraint at a violation (MuJoCo, solver parameters)."""
    low = wp.clamp(solimp[0], MIN_IMPEDANCE, MAX_IMPEDANCE)
    high = wp.clamp(solimp[1], MIN_IMPEDANCE, MAX_IMPEDANCE)
    mid = wp.clamp(solimp[3], MIN_IMPEDANCE, MAX_IMPEDANCE)
    power = wp.max(1.0, solimp[4])
    stiffness = -solref[0] / (high * high)
    damping = -solref[1] / high
    if solref[0] > 0.0:
        time = wp.max(solref[0], 2.0 * timestep)
        stiffness = 1.0 / wp.max(MIN_VALUE, high * high * time * time * solref[1] * solref[1])
        damping = 2.0 / wp.max(MIN_VALUE, high * time)
    x = wp.abs(pos) / wp.max(MIN_VALUE, solimp[2])
    share = float(1.0)
    if solimp[2] <= MIN_VALUE:
        share = 0.5
    elif x < mid:
        share = wp.pow(x, power) / wp.pow(mid, power - 1.0)
    elif x < 1.0:
        share = 1.0 - wp.pow(1.0 - x, power) / wp.pow(1.0 - mid, power - 1.0)
    return wp.vec3(stiffness, damping, low + share * (high - low))


@wp.func
def constraint_mass(invweight: float, impedance: float) -> float:
    """Return D, the inverse of the regularized diagonal of J M^-1 J^T."""
    return 1.0 / wp.max(MIN_VALUE, invweight * (1.0 - impedance) / impedance)


@wp.func
def floor_normal(robot: Robot, world: int) -> wp.vec3:
    """Return the unit normal of the floor."""
    rot = quat_to_matrix(robot.geom_quat[row(world, robot.geom_quat.shape[0]), robot.floor])
    return wp.vec3(rot[0, 2], rot[1, 2], rot[2, 2])


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
    robot: Robot, world: int, geom: int, dist: float, velocity: wp.vec3, normal: wp.vec3, contact: Contact
) -> Contact:
    """Return a contact with friction, mass and references of its rows, mixed from geom and floor as MuJoCo does."""
    floor = robot.floor
    mix_row = row(world, robot.geom_solmix.shape[0])
    ref_row = row(world, robot.geom_solref.shape[0])
    imp_row = row(world, robot.geom_solimp.shape[0])
    fri_row = row(world, robot.geom_friction.shape[0])
    weight_floor, weight_geom = robot.geom_solmix[mix_row, floor], robot.geom_solmix[mix_row, geom]
    mix = float(0.5)
    if weight_floor + weight_geom > 2.0 * MIN_VALUE:
        mix = weight_geom / (weight_floor + weight_geom)
    ref_floor, ref_geom = robot.geom_solref[ref_row, floor], robot.geom_solref[ref_row, geom]
    solref = wp.min(ref_floor, ref_geom)
    if ref_floor[0] > 0.0 and ref_geom[0] > 0.0:
        solref = mix * ref_geom + (1.0 - mix) * ref_floor
    friction = wp.max(robot.geom_friction[fri_row, floor][0], robot.geom_friction[fri_row, geom][0])
    if robot.geom_priority[geom] > robot.geom_priority[floor]:
        mix = 1.0
        solref = 1.0 * ref_geom
        friction = robot.geom_friction[fri_row, geom][0]
    if robot.geom_priority[geom] < robot.geom_priority[floor]:
        mix = 0.0
        solref = 1.0 * ref_floor
        friction = robot.geom_friction[fri_row, floor][0]
    solimp = mix * robot.geom_solimp[imp_row, geom] + (1.0 - mix) * robot.geom_solimp[imp_row, floor]
    params = reference_dynamics(solref, solimp, dist, robot.timestep)
    friction = wp.max(friction, MIN_FRICTION)
    invweight = robot.body_invweight0[row(world, robot.body_invweight0.shape[0]), robot.geom_bodyid[geom]][0]
    invweight *= (1.0 + friction * friction) * 2.0 * friction * friction / robot.impratio
    contact.friction = friction
    contact.mass = wp.min(constraint_mass(invweight, params[2]), MAX_CONTACT_MASS)
    along = row_values(contact, normal, velocity)
    contact.reference = vec4(-params[0] * params[2] * dist) - params[1] * along
    return contact


@wp.func
def row_values(contact: Contact, normal: wp.vec3, motion: wp.vec3) -> vec4:
    """Return a motion of the contact point along its four rows: normal +- friction x each tangent."""
    up = wp.dot(normal, motion)
    first = contact.friction * wp.dot(contact.tangent, motion)
    second = contact.friction * wp.dot(wp.cross(normal, contact.tangent), motion)
    return vec4(up + first, up - first, up + second, up - second)


@wp.func
def row_force(mass: float, x: float) -> float:
    """Return the force of a one-sided row: it only pushes."""
    return wp.max(0.0, -mass * x)


@wp.func
def contact_force(contact: Contact, normal: wp.vec3, x: vec4) -> wp.vec3:
    """Return the force on the robot in world axes [N] from the residuals J qacc - a_ref of its rows."""
    f0, f1 = row_force(contact.mass, x[0]), row_force(contact.mass, x[1])
    f2, f3 = row_force(contact.mass, x[2]), row_force(contact.mass, x[3])
    second = wp.cross(normal, contact.tangent)
    sideways = contact.friction * ((f0 - f1) * contact.tangent + (f2 - f3) * second)
    return (f0 + f1 + f2 + f3) * normal + sideways


@wp.func
def contact_stiffness(contact: Contact, normal: wp.vec3, x: vec4) -> wp.mat33:
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
        if x[k] < 0.0:
            result += contact.mass * wp.outer(direction, direction)
    return result


@functools.cache
def branch_constraints(n: int) -> SimpleNamespace:
    """Return the types and functions for the constraints of branches of ``n`` joints."""
    vector = branch_dynamics(n).vector

    @wp.struct
    class JointRows:
        """Friction rows, one per joint, and limit rows, at most one per joint."""

        friction_mass: vector  # D, 0 without dry friction
        friction_loss: vector
        friction_reference: vector
        limit_mass: vector  # D, 0 inside the range
        limit_sign: vector  # +1 at the lower limit, -1 at the upper one
        limit_reference: vector

    @wp.func
    def make_joint_rows(
        robot: Robot, world: int, branch: int, qpos: wp.array2d(dtype=float), qvel: wp.array2d(dtype=float)
    ) -> JointRows:
        """Return the friction and limit rows of a branch."""
        rows = JointRows()
        for j in range(wp.static(n)):
            joint = robot.branch_joint[branch, j]
            dof = joint + 5
            vel = qvel[world, dof]
            invweight = robot.dof_invweight0[row(world, robot.dof_invweight0.shape[0]), dof]
            loss = robot.dof_frictionloss[row(world, robot.dof_frictionloss.shape[0]), dof]
            if loss > 0.0:
                solref = robot.dof_solref[row(world, robot.dof_solref.shape[0]), dof]
                solimp = robot.dof_solimp[row(world, robot.dof_solimp.shape[0]), dof]
                params = reference_dynamics(solref, solimp, 0.0, robot.timestep)
                rows.friction_loss[j] = loss
                rows.friction_mass[j] = constraint_mass(invweight, params[2])
                rows.friction_reference[j] = -params[1] * vel
            limits = robot.jnt_range[row(world, robot.jnt_range.shape[0]), joint]
            below, above = qpos[world, joint + 6] - limits[0], limits[1] - qpos[world, joint + 6]
            dist = wp.min(below, above)
            if dist < 0.0:
                sign = wp.where(below < above, 1.0, -1.0)
                solref = robot.jnt_solref[row(world, robot.jnt_solref.shape[0]), joint]
                solimp = robot.jnt_solimp[row(world, robot.jnt_solimp.shape[0]), joint]
                params = reference_dynamics(solref, solimp, dist, robot.timestep)
                rows.limit_sign[j] = sign
                rows.limit_mass[j] = constraint_mass(invweight, params[2])
                rows.limit_reference[j] = -params[0] * params[2] * dist - params[1] * sign * vel
        return rows

    @wp.func
    def find_contacts(
        robot: Robot, world: int, branch: int, origin: wp.vec3, normal: wp.vec3, positions: wp.array(dtype=wp.vec3),
        rotations: wp.array(dtype=wp.mat33), ang_vels: wp.array(dtype=wp.vec3), lin_vels: wp.array(dtype=wp.vec3),
        contacts: wp.array(dtype=Contact), start: int,
    ) -> int:  # fmt: skip
        """Write the contacts of a branch with the floor from index ``start`` on and return how many there are."""
        count = int(0)
        last_geom = int(-1)
        in_geom = int(0)
        height = origin - robot.geom_pos[row(world, robot.geom_pos.shape[0]), robot.floor]
        for point in range(robot.point_count[branch]):
            geom = robot.point_geom[branch, point]
            depth = robot.point_depth[branch, point]
            size = robot.geom_size[row(world, robot.geom_size.shape[0]), geom]
            is_capsule = robot.geom_type[geom] == CAPSULE
            half = size
            if is_capsule:
                half = wp.vec3(0.0, 0.0, size[1])
            turn = rotations[depth] * quat_to_matrix(robot.geom_quat[row(world, robot.geom_quat.shape[0]), geom])
            centre = positions[depth] + rotations[depth] * robot.geom_pos[row(world, robot.geom_pos.shape[0]), geom]
            arm = turn * wp.cw_mul(robot.point_offset[branch, point], half)
            centre += arm
            radius = robot.point_radius[branch, point] * size[0]
            dist = wp.dot(height + centre, normal) - radius
            if geom != last_geom:
                last_geom = geom
                in_geom = 0
            if robot.geom_type[geom] == BOX and (wp.dot(arm, normal) > 0.0 or in_geom == MAX_CORNERS):
                dist = 0.0
            if dist < 0.0:
                in_geom += 1
                contact = Contact()
                contact.pos = centre - (radius + 0.5 * dist) * normal
                contact.depth = depth
                contact.sensor = robot.geom_sensor[geom]
                contact.tangent = contact_tangent(normal, wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2]), is_capsule)
                velocity = lin_vels[depth] + wp.cross(ang_vels[depth], contact.pos)
                contacts[start + count] = set_contact_rows(robot, world, geom, dist, velocity, normal, contact)
                count += 1
        return count

    return SimpleNamespace(JointRows=JointRows, make_joint_rows=make_joint_rows, find_contacts=find_contacts)
