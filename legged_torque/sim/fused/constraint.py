"""Constraint rows of joints and contacts: their masses, references and forces, as in MuJoCo."""

import warp as wp

from legged_torque.sim.fused.model import Model, State, dof, of_world, qadr
from legged_torque.sim.fused.types import AnyRows, vec4, vec5

MIN_VALUE = wp.constant(1.0e-15)
MIN_IMPEDANCE = wp.constant(1.0e-4)
MAX_IMPEDANCE = wp.constant(0.9999)
"""MuJoCo's mjMINVAL, mjMINIMP and mjMAXIMP."""
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
def friction_force(mass: float, loss: float, x: float) -> float:
    """Return the force of a dry friction row: as its spring says, up to the loss."""
    return wp.clamp(-mass * x, -loss, loss)


@wp.func
def friction_state(force: float, loss: float) -> float:
    """Return in which of its three states a dry friction row is: -1, 0 or 1."""
    return wp.where(force <= -loss, -1.0, wp.where(force >= loss, 1.0, 0.0))


@wp.func
def row_force(mass: float, x: float) -> float:
    """Return the force of a one-sided row: it only pushes."""
    return wp.max(0.0, -mass * x)


@wp.func
def make_joint_rows(rows: AnyRows, model: Model, state: State, world: int, b: int, joints: int):
    """Return the friction and limit rows of a branch, given ones that are all zero."""
    for j in range(len(rows.limit_mass)):
        if j < joints:
            joint = model.branch_joint[b, j]
            vel = state.qvel[world, dof(joint)]
            invweight = of_world(model.dof_invweight0, world, dof(joint))
            loss = of_world(model.dof_frictionloss, world, dof(joint))
            if loss > 0.0:
                solref = of_world(model.dof_solref, world, dof(joint))
                solimp = of_world(model.dof_solimp, world, dof(joint))
                params = reference_dynamics(solref, solimp, 0.0, model.timestep)
                rows.friction_loss[j] = loss
                rows.friction_mass[j] = constraint_mass(invweight, params[2])
                rows.friction_reference[j] = -params[1] * vel
            limits = of_world(model.jnt_range, world, joint)
            pos = state.qpos[world, qadr(joint)]
            below, above = pos - limits[0], limits[1] - pos
            dist = wp.min(below, above)
            if dist < 0.0:
                sign = wp.where(below < above, 1.0, -1.0)
                solref = of_world(model.jnt_solref, world, joint)
                solimp = of_world(model.jnt_solimp, world, joint)
                params = reference_dynamics(solref, solimp, dist, model.timestep)
                rows.limit_sign[j] = sign
                rows.limit_mass[j] = constraint_mass(invweight, params[2])
                rows.limit_reference[j] = -params[0] * params[2] * dist - params[1] * sign * vel
    return rows


@wp.struct
class ContactParams:
    """Friction and softness of a contact of two geoms."""

    friction: wp.float32
    solref: wp.vec2
    solimp: vec5


@wp.func
def contact_params(model: Model, world: int, first: int, second: int) -> ContactParams:
    """Return friction, solref and solimp of a contact of two geoms, mixed as MuJoCo does."""
    weight_first, weight_second = (
        of_world(model.geom_solmix, world, first),
        of_world(model.geom_solmix, world, second),
    )
    mix = float(0.5)
    if weight_first + weight_second > 2.0 * MIN_VALUE:
        mix = weight_second / (weight_first + weight_second)
    ref_first, ref_second = of_world(model.geom_solref, world, first), of_world(model.geom_solref, world, second)
    solref = wp.min(ref_first, ref_second)
    if ref_first[0] > 0.0 and ref_second[0] > 0.0:
        solref = mix * ref_second + (1.0 - mix) * ref_first
    friction_first = of_world(model.geom_friction, world, first)[0]
    friction_second = of_world(model.geom_friction, world, second)[0]
    friction = wp.max(friction_first, friction_second)
    if model.geom_priority[second] > model.geom_priority[first]:
        mix = 1.0
        solref = 1.0 * ref_second
        friction = 1.0 * friction_second
    if model.geom_priority[second] < model.geom_priority[first]:
        mix = 0.0
        solref = 1.0 * ref_first
        friction = 1.0 * friction_first
    solimp_first, solimp_second = (
        of_world(model.geom_solimp, world, first),
        of_world(model.geom_solimp, world, second),
    )
    solimp = mix * solimp_second + (1.0 - mix) * solimp_first
    return ContactParams(friction, solref, solimp)


@wp.func
def with_rows(
    model: Model,
    world: int,
    geoms: wp.vec2i,
    params: ContactParams,
    dist: float,
    velocity: wp.vec3,
    normal: wp.vec3,
    contact: Contact,
) -> Contact:
    """Return a contact of two geoms with friction, mass and references of its rows.

    Velocity is that of the second geom relative to the first one; the normal points to the second geom.
    """
    dynamics = reference_dynamics(params.solref, params.solimp, dist, model.timestep)
    friction = wp.max(params.friction, MIN_FRICTION)
    invweight = of_world(model.body_invweight0, world, model.geom_bodyid[geoms[0]])[0]  # the world's is 0
    invweight += of_world(model.body_invweight0, world, model.geom_bodyid[geoms[1]])[0]
    regularized = invweight * (1.0 + friction * friction) * 2.0 * friction * friction / model.impratio
    contact.friction = friction
    contact.mass = wp.min(constraint_mass(regularized, dynamics[2]), MAX_CONTACT_MASS / wp.max(invweight, MIN_VALUE))
    along = row_values(contact, normal, velocity)
    contact.reference = vec4(-dynamics[0] * dynamics[2] * dist) - dynamics[1] * along
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
