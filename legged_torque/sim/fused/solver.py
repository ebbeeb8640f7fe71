"""MuJoCo's constraint solver (Newton, exact line search) on the equations of a trunk with branches.

The solver minimizes, over accelerations a, the cost 1/2 (a - a_0)^T M (a - a_0) + s(J a - a_ref), where a_0 are the
accelerations without constraints. Branches are coupled through the trunk only, so the Newton system has the shape of
an arrow: each branch is eliminated by itself, which leaves six equations for the trunk.

This file has the functions of one branch, in the order of an iteration; ``newton`` loops over the branches of a thread.
"""

import warp as wp

from legged_torque.sim.fused.collision import contact_normal
from legged_torque.sim.fused.constraint import (
    Contact,
    contact_force,
    contact_stiffness,
    expected_rows,
    friction_force,
    friction_state,
    pushing_rows,
    row_force,
    row_values,
)
from legged_torque.sim.fused.math import cholesky, cholesky_solve, column, forward_solve, with_column
from legged_torque.sim.fused.trunk import TrunkMotion, TrunkSystem
from legged_torque.sim.fused.types import AnyBranch, AnyColumns, AnyContacts, AnyMatrix, AnyVector, vec4


@wp.func
def joint_rows_times(branch: AnyBranch, a: AnyVector):
    """Return J a of the joint rows."""
    out = type(branch.residuals)()
    out.friction = 1.0 * a
    out.limit = wp.cw_mul(branch.rows.limit_sign, a)
    return out


@wp.func
def contact_rows_times(
    branch: AnyBranch, rot: wp.mat33, trunk: TrunkMotion, a: AnyVector, normal: wp.vec3, contact: Contact
) -> vec4:
    """Return J a of a contact's rows."""
    lin = 1.0 * trunk.lin
    ang = rot * trunk.ang
    for j in range(len(a)):
        if j < contact.depth:
            lin += a[j] * column(branch.smooth.lever, j)
            ang += a[j] * column(branch.smooth.axis, j)
    return row_values(contact, normal, lin + wp.cross(ang, contact.pos))


@wp.func
def start(branch: AnyBranch, rot: wp.mat33, trunk_acc: TrunkMotion, contacts: AnyContacts):
    """Return a branch with the residuals of the accelerations at the start.

    Contacts push with the rows that are expected to push, whatever these accelerations are. That is a better start than
    the rows that push there, since small changes of velocities turn the signs of stiff rows.
    """
    branch.residuals = joint_rows_times(branch, branch.acc)
    branch.residuals.friction = branch.residuals.friction - branch.rows.friction_reference
    branch.residuals.limit = branch.residuals.limit - branch.rows.limit_reference
    for k in range(branch.first_contact, branch.first_contact + branch.num_contacts):
        contact = contacts.found[k]
        motion = contact_rows_times(branch, rot, trunk_acc, branch.acc, contact_normal(contacts, k), contact)
        contacts.residual[k] = motion - contact.reference
        contacts.pushing[k] = expected_rows(contact)
    return branch


@wp.func
def assemble(branch: AnyBranch, rot: wp.mat33, trunk_acc: TrunkMotion, contacts: AnyContacts):
    """Return a branch with gradient and Hessian of the cost, not factored yet, and its contacts' terms for the trunk.

    Only contacts with the ground count here; ``constraint_self`` has the others.
    """
    add = TrunkSystem()
    hessian = 1.0 * branch.smooth.mass
    coupling_lin = 1.0 * branch.smooth.mass_lin
    coupling_ang = 1.0 * branch.smooth.mass_ang
    gradient = branch.smooth.mass * branch.acc - branch.smooth.force
    gradient += wp.transpose(coupling_lin) * trunk_acc.lin + wp.transpose(coupling_ang) * trunk_acc.ang
    gradient_lin = coupling_lin * branch.acc
    gradient_ang = coupling_ang * branch.acc
    for j in range(len(branch.acc)):
        friction_mass, friction_x = branch.rows.friction_mass[j], branch.residuals.friction[j]
        gradient[j] -= friction_force(friction_mass, branch.rows.friction_loss[j], friction_x)
        if wp.abs(friction_mass * friction_x) < branch.rows.friction_loss[j]:
            hessian[j, j] += friction_mass
        limit_mass, limit_x = branch.rows.limit_mass[j], branch.residuals.limit[j]
        gradient[j] -= branch.rows.limit_sign[j] * row_force(limit_mass, limit_x)
        if limit_x < 0.0:
            hessian[j, j] += limit_mass
    for k in range(branch.first_contact, branch.first_contact + branch.num_contacts):
        contact = contacts.found[k]
        lever = -wp.skew(contact.pos) * rot  # motion of the point per unit of the trunk's rotation
        jacobian = type(branch.coupling_lin)()
        for j in range(len(branch.acc)):
            if j < contact.depth:
                motion = column(branch.smooth.lever, j) + wp.cross(column(branch.smooth.axis, j), contact.pos)
                jacobian = with_column(jacobian, j, motion)
        pushing = contacts.pushing[k]
        force = contact_force(contact, contact_normal(contacts, k), contacts.residual[k], pushing)
        gradient -= wp.transpose(jacobian) * force
        gradient_lin -= force
        gradient_ang -= wp.transpose(lever) * force
        stiffness = contact_stiffness(contact, contact_normal(contacts, k), pushing)
        pushed = stiffness * jacobian
        hessian += wp.transpose(jacobian) * pushed
        coupling_lin += pushed
        coupling_ang += wp.transpose(lever) * pushed
        add.lin += stiffness
        add.coupling += stiffness * lever
        add.ang += wp.transpose(lever) * stiffness * lever
    branch.factor = hessian
    branch.coupling_lin = coupling_lin
    branch.coupling_ang = coupling_ang
    branch.gradient = gradient
    branch.trunk_gradient_lin = gradient_lin
    branch.trunk_gradient_ang = gradient_ang
    return branch, add


@wp.func
def assemble_damping(branch: AnyBranch, timestep: float):
    """Return a branch with the equations of the change that implicit damping makes: (M + h D) da = -h D a."""
    hessian = 1.0 * branch.smooth.mass
    for j in range(len(branch.acc)):
        hessian[j, j] += timestep * branch.smooth.damping[j]
    branch.factor = cholesky(hessian)
    branch.coupling_lin = branch.smooth.mass_lin
    branch.coupling_ang = branch.smooth.mass_ang
    branch.gradient = timestep * wp.cw_mul(branch.smooth.damping, branch.acc)
    branch.trunk_gradient_lin = wp.vec3(0.0)
    branch.trunk_gradient_ang = wp.vec3(0.0)
    return branch


@wp.func
def solve_rows(factor: AnyMatrix, c: AnyColumns):
    """Return C L^-T from the factor L of H = L L^T; the product with its transpose is C H^-1 C^T."""
    out = type(c)()
    for r in range(3):
        out[r] = forward_solve(factor, c[r])
    return out


@wp.func
def eliminate(branch: AnyBranch, system: TrunkSystem, add: TrunkSystem) -> TrunkSystem:
    """Add the Schur complement of a branch, and the terms of its contacts, to the trunk's equations."""
    gradient = forward_solve(branch.factor, branch.gradient)
    lin, ang = solve_rows(branch.factor, branch.coupling_lin), solve_rows(branch.factor, branch.coupling_ang)
    system.rhs_lin = system.rhs_lin + lin * gradient - branch.trunk_gradient_lin
    system.rhs_ang = system.rhs_ang + ang * gradient - branch.trunk_gradient_ang
    system.lin = system.lin + add.lin - lin * wp.transpose(lin)
    system.coupling = system.coupling + add.coupling - lin * wp.transpose(ang)
    system.ang = system.ang + add.ang - ang * wp.transpose(ang)
    return system


@wp.func
def add_whole(branch: AnyBranch, system: TrunkSystem, add: TrunkSystem) -> TrunkSystem:
    """Add the terms of a branch and its contacts to the trunk's equations, before anything is eliminated."""
    system.rhs_lin = system.rhs_lin - branch.trunk_gradient_lin
    system.rhs_ang = system.rhs_ang - branch.trunk_gradient_ang
    system.lin = system.lin + add.lin
    system.coupling = system.coupling + add.coupling
    system.ang = system.ang + add.ang
    return system


@wp.func
def branch_step(branch: AnyBranch, trunk_step: TrunkMotion):
    """Return a branch's part of the step."""
    rhs = branch.gradient + wp.transpose(branch.coupling_lin) * trunk_step.lin
    rhs += wp.transpose(branch.coupling_ang) * trunk_step.ang
    return -cholesky_solve(branch.factor, rhs)


@wp.func
def along_step(branch: AnyBranch, rot: wp.mat33, trunk_step: TrunkMotion, contacts: AnyContacts):
    """Return a branch with the changes of its residuals along its step, and the slope of its rows' cost along it."""
    branch.change = joint_rows_times(branch, branch.step)
    slope = float(0.0)
    for j in range(len(branch.acc)):
        friction = friction_force(
            branch.rows.friction_mass[j], branch.rows.friction_loss[j], branch.residuals.friction[j]
        )
        slope -= friction * branch.change.friction[j]
        slope -= row_force(branch.rows.limit_mass[j], branch.residuals.limit[j]) * branch.change.limit[j]
    for k in range(branch.first_contact, branch.first_contact + branch.num_contacts):
        contact = contacts.found[k]
        change = contact_rows_times(branch, rot, trunk_step, branch.step, contact_normal(contacts, k), contact)
        slope += contact.mass * wp.dot(wp.cw_mul(contacts.pushing[k], contacts.residual[k]), change)
        contacts.change[k] = change
    return branch, slope


@wp.func
def add_contact_slopes(slopes: wp.vec2, contacts: AnyContacts, k: int, alpha: float) -> wp.vec2:
    """Return first and second derivative of the rows' cost along the step, with those of a contact's rows added."""
    mass = contacts.found[k].mass
    along = contacts.change[k]
    values = contacts.residual[k] + alpha * along
    for r in range(4):
        if values[r] < 0.0:
            slopes[0] += mass * values[r] * along[r]
            slopes[1] += mass * along[r] * along[r]
    return slopes


@wp.func
def row_slopes(branch: AnyBranch, contacts: AnyContacts, alpha: float) -> wp.vec2:
    """Return first and second derivative of the rows' cost along the step, at a share ``alpha`` of it."""
    slope = float(0.0)
    curvature = float(0.0)
    for j in range(len(branch.acc)):
        mass, loss, along = branch.rows.friction_mass[j], branch.rows.friction_loss[j], branch.change.friction[j]
        value = branch.residuals.friction[j] + alpha * along
        slope -= friction_force(mass, loss, value) * along
        if wp.abs(mass * value) < loss:
            curvature += mass * along * along
        along = branch.change.limit[j]
        value = branch.residuals.limit[j] + alpha * along
        if value < 0.0:
            slope += branch.rows.limit_mass[j] * value * along
            curvature += branch.rows.limit_mass[j] * along * along
    slopes = wp.vec2(slope, curvature)
    for k in range(branch.first_contact, branch.first_contact + branch.num_contacts):
        slopes = add_contact_slopes(slopes, contacts, k, alpha)
    return slopes


@wp.func
def slopes_at_start(branch: AnyBranch, trunk_step: TrunkMotion, of_rows: float) -> wp.vec3:
    """Return a branch's slope of the whole cost along the step, and slope and curvature of its smooth part."""
    slope = wp.dot(branch.step, branch.gradient)
    slope += wp.dot(trunk_step.lin, branch.trunk_gradient_lin) + wp.dot(trunk_step.ang, branch.trunk_gradient_ang)
    curvature = wp.dot(branch.step, branch.smooth.mass * branch.step)
    curvature += 2.0 * wp.dot(branch.smooth.mass_lin * branch.step, trunk_step.lin)
    curvature += 2.0 * wp.dot(branch.smooth.mass_ang * branch.step, trunk_step.ang)
    return wp.vec3(slope, slope - of_rows, curvature)


@wp.func
def move_contact(contacts: AnyContacts, k: int, alpha: float) -> float:
    """Move a contact by a share of the step and return how many of its rows changed their state on the way."""
    before = contacts.pushing[k]
    contacts.residual[k] = contacts.residual[k] + alpha * contacts.change[k]
    after = pushing_rows(contacts.residual[k])
    contacts.pushing[k] = after
    return wp.length_sq(after - before)


@wp.func
def move(branch: AnyBranch, contacts: AnyContacts, alpha: float):
    """Return a branch moved by a share of the step, and how many rows changed their state on the way."""
    flips = float(0.0)
    branch.acc = branch.acc + alpha * branch.step
    for j in range(len(branch.acc)):
        mass, loss = branch.rows.friction_mass[j], branch.rows.friction_loss[j]
        old, new = branch.residuals.friction[j], branch.residuals.friction[j] + alpha * branch.change.friction[j]
        flips += wp.abs(friction_state(mass * old, loss) - friction_state(mass * new, loss))
        old_limit, new_limit = branch.residuals.limit[j], branch.residuals.limit[j] + alpha * branch.change.limit[j]
        flips += wp.where((old_limit < 0.0) != (new_limit < 0.0), 1.0, 0.0)
    branch.residuals.friction = branch.residuals.friction + alpha * branch.change.friction
    branch.residuals.limit = branch.residuals.limit + alpha * branch.change.limit
    for k in range(branch.first_contact, branch.first_contact + branch.num_contacts):
        flips += move_contact(contacts, k, alpha)
    return branch, flips
