"""MuJoCo's constraint solver (Newton, exact line search) on the equations of a trunk with branches.

The solver minimizes, over accelerations a, the cost 1/2 (a - a_0)^T M (a - a_0) + s(J a - a_ref), where a_0 are the
accelerations without constraints. Branches are coupled through the trunk only, so the Newton system has the shape of
an arrow: each branch is eliminated by itself, which leaves six equations for the trunk.
"""

import functools
from types import SimpleNamespace

import warp as wp

from legged_torque.sim.fused.constraints import (
    Contact,
    branch_constraints,
    contact_force,
    contact_stiffness,
    row_force,
    row_values,
)
from legged_torque.sim.fused.dynamics import branch_dynamics
from legged_torque.sim.fused.math import linear_algebra, vec4
from legged_torque.sim.fused.trunk import TrunkMotion, TrunkSystem


@wp.func
def friction_force(mass: float, loss: float, x: float) -> float:
    """Return the force of a dry friction row: as its spring says, up to the loss."""
    return wp.clamp(-mass * x, -loss, loss)


@functools.cache
def branch_newton(n: int) -> SimpleNamespace:
    """Return the types and functions of the solver for branches of ``n`` joints.

    Returns:
        ``Leg``, the state of a branch in the solver, and the parts of an iteration in their order.
    """
    dynamics, constraints, algebra = branch_dynamics(n), branch_constraints(n), linear_algebra(n)
    vector, matrix, columns = dynamics.vector, dynamics.matrix, dynamics.columns
    Branch, JointRows = dynamics.Branch, constraints.JointRows
    column, with_column = dynamics.column, dynamics.with_column
    cholesky, cholesky_solve = algebra.cholesky, algebra.cholesky_solve

    @wp.struct
    class Residuals:
        """J a - a_ref of the joint rows, or J times a direction."""

        friction: vector
        limit: vector

    @wp.struct
    class Leg:
        """A branch in the solver: its equations, where it is, and where it goes."""

        branch: Branch
        rows: JointRows
        first_contact: int  # its contacts' indices
        num_contacts: int
        acc: vector
        residuals: Residuals
        step: vector
        change: Residuals  # of the residuals per unit of the step
        factor: matrix  # Cholesky factor of the Hessian's block
        coupling_lin: columns  # Hessian's blocks with the trunk
        coupling_ang: columns
        gradient: vector
        trunk_gradient_lin: wp.vec3  # this branch's part
        trunk_gradient_ang: wp.vec3

    @wp.func
    def joint_rows_times(rows: JointRows, a: vector) -> Residuals:
        """Return J a of the joint rows."""
        out = Residuals()
        out.friction = 1.0 * a
        out.limit = wp.cw_mul(rows.limit_sign, a)
        return out

    @wp.func
    def contact_rows_times(
        branch: Branch, rot: wp.mat33, trunk: TrunkMotion, a: vector, normal: wp.vec3, contact: Contact
    ) -> vec4:
        """Return J a of a contact's rows."""
        lin = 1.0 * trunk.lin
        ang = rot * trunk.ang
        for j in range(wp.static(n)):
            if j < contact.depth:
                lin += a[j] * column(branch.lever, j)
                ang += a[j] * column(branch.axis, j)
        return row_values(contact, normal, lin + wp.cross(ang, contact.pos))

    @wp.func
    def start_leg(
        leg: Leg, rot: wp.mat33, trunk_acc: TrunkMotion, normal: wp.vec3, contacts: wp.array(dtype=Contact),
        x: wp.array(dtype=vec4),
    ) -> Leg:  # fmt: skip
        """Return a branch with the residuals of the accelerations that it starts from."""
        leg.residuals = joint_rows_times(leg.rows, leg.acc)
        leg.residuals.friction = leg.residuals.friction - leg.rows.friction_reference
        leg.residuals.limit = leg.residuals.limit - leg.rows.limit_reference
        for k in range(leg.first_contact, leg.first_contact + leg.num_contacts):
            x[k] = contact_rows_times(leg.branch, rot, trunk_acc, leg.acc, normal, contacts[k]) - contacts[k].reference
        return leg

    @wp.func
    def assemble(
        leg: Leg, rot: wp.mat33, trunk_acc: TrunkMotion, normal: wp.vec3, contacts: wp.array(dtype=Contact),
        x: wp.array(dtype=vec4),
    ):  # fmt: skip
        """Return a branch with gradient and Hessian of the cost, and what its contacts add for the trunk."""
        add = TrunkSystem()
        hessian = 1.0 * leg.branch.mass
        coupling_lin = 1.0 * leg.branch.mass_lin
        coupling_ang = 1.0 * leg.branch.mass_ang
        gradient = leg.branch.mass * leg.acc - leg.branch.force
        gradient += wp.transpose(coupling_lin) * trunk_acc.lin + wp.transpose(coupling_ang) * trunk_acc.ang
        gradient_lin = coupling_lin * leg.acc
        gradient_ang = coupling_ang * leg.acc
        for j in range(wp.static(n)):
            friction_mass, friction_x = leg.rows.friction_mass[j], leg.residuals.friction[j]
            gradient[j] -= friction_force(friction_mass, leg.rows.friction_loss[j], friction_x)
            if wp.abs(friction_mass * friction_x) < leg.rows.friction_loss[j]:
                hessian[j, j] += friction_mass
            limit_mass, limit_x = leg.rows.limit_mass[j], leg.residuals.limit[j]
            gradient[j] -= leg.rows.limit_sign[j] * row_force(limit_mass, limit_x)
            if limit_x < 0.0:
                hessian[j, j] += limit_mass
        for k in range(leg.first_contact, leg.first_contact + leg.num_contacts):
            contact = contacts[k]
            lever = -wp.skew(contact.pos) * rot  # motion of the point per unit of the trunk's rotation
            jacobian = columns()
            for j in range(wp.static(n)):
                if j < contact.depth:
                    motion = column(leg.branch.lever, j) + wp.cross(column(leg.branch.axis, j), contact.pos)
                    jacobian = with_column(jacobian, j, motion)
            force = contact_force(contact, normal, x[k])
            gradient -= wp.transpose(jacobian) * force
            gradient_lin -= force
            gradient_ang -= wp.transpose(lever) * force
            stiffness = contact_stiffness(contact, normal, x[k])
            pushed = stiffness * jacobian
            hessian += wp.transpose(jacobian) * pushed
            coupling_lin += pushed
            coupling_ang += wp.transpose(lever) * pushed
            add.lin += stiffness
            add.coupling += stiffness * lever
            add.ang += wp.transpose(lever) * stiffness * lever
        leg.factor = cholesky(hessian)
        leg.coupling_lin = coupling_lin
        leg.coupling_ang = coupling_ang
        leg.gradient = gradient
        leg.trunk_gradient_lin = gradient_lin
        leg.trunk_gradient_ang = gradient_ang
        return leg, add

    @wp.func
    def assemble_damping(leg: Leg, timestep: float) -> Leg:
        """Return a branch with the equations of the change that implicit damping makes: (M + h D) da = -h D a."""
        hessian = 1.0 * leg.branch.mass
        for j in range(wp.static(n)):
            hessian[j, j] += timestep * leg.branch.damping[j]
        leg.factor = cholesky(hessian)
        leg.coupling_lin = leg.branch.mass_lin
        leg.coupling_ang = leg.branch.mass_ang
        leg.gradient = timestep * wp.cw_mul(leg.branch.damping, leg.acc)
        leg.trunk_gradient_lin = wp.vec3(0.0)
        leg.trunk_gradient_ang = wp.vec3(0.0)
        return leg

    @wp.func
    def solve_rows(factor: matrix, c: columns) -> columns:
        """Return C H^-1 from the factor of H."""
        out = columns()
        for r in range(3):
            line = vector()
            for j in range(wp.static(n)):
                line[j] = c[r, j]
            line = cholesky_solve(factor, line)
            for j in range(wp.static(n)):
                out[r, j] = line[j]
        return out

    @wp.func
    def eliminate(leg: Leg, system: TrunkSystem, add: TrunkSystem) -> TrunkSystem:
        """Add to the trunk's equations what is left there of a branch's (Schur complement) and of its contacts."""
        free = cholesky_solve(leg.factor, leg.gradient)  # the branch's own step, less the sign
        system.rhs_lin = system.rhs_lin + leg.coupling_lin * free - leg.trunk_gradient_lin
        system.rhs_ang = system.rhs_ang + leg.coupling_ang * free - leg.trunk_gradient_ang
        solved_lin = solve_rows(leg.factor, leg.coupling_lin)
        system.lin = system.lin + add.lin - solved_lin * wp.transpose(leg.coupling_lin)
        system.coupling = system.coupling + add.coupling - solved_lin * wp.transpose(leg.coupling_ang)
        solved_ang = solve_rows(leg.factor, leg.coupling_ang)
        system.ang = system.ang + add.ang - solved_ang * wp.transpose(leg.coupling_ang)
        return system

    @wp.func
    def branch_step(leg: Leg, trunk_step: TrunkMotion) -> vector:
        """Return a branch's part of the step."""
        rhs = leg.gradient + wp.transpose(leg.coupling_lin) * trunk_step.lin
        rhs += wp.transpose(leg.coupling_ang) * trunk_step.ang
        return -cholesky_solve(leg.factor, rhs)

    @wp.func
    def turn_to(
        leg: Leg, rot: wp.mat33, trunk_step: TrunkMotion, normal: wp.vec3, contacts: wp.array(dtype=Contact),
        dx: wp.array(dtype=vec4),
    ) -> Leg:  # fmt: skip
        """Return a branch with its part of the Newton step and the changes of its residuals along it."""
        leg.step = branch_step(leg, trunk_step)
        leg.change = joint_rows_times(leg.rows, leg.step)
        for k in range(leg.first_contact, leg.first_contact + leg.num_contacts):
            dx[k] = contact_rows_times(leg.branch, rot, trunk_step, leg.step, normal, contacts[k])
        return leg

    @wp.func
    def row_slopes(
        leg: Leg, contacts: wp.array(dtype=Contact), x: wp.array(dtype=vec4), dx: wp.array(dtype=vec4), alpha: float
    ) -> wp.vec2:
        """Return first and second derivative of the rows' cost along the step, at a share ``alpha`` of it."""
        slope = float(0.0)
        curvature = float(0.0)
        for j in range(wp.static(n)):
            mass, loss, along = leg.rows.friction_mass[j], leg.rows.friction_loss[j], leg.change.friction[j]
            value = leg.residuals.friction[j] + alpha * along
            slope -= friction_force(mass, loss, value) * along
            if wp.abs(mass * value) < loss:
                curvature += mass * along * along
            along = leg.change.limit[j]
            value = leg.residuals.limit[j] + alpha * along
            if value < 0.0:
                slope += leg.rows.limit_mass[j] * value * along
                curvature += leg.rows.limit_mass[j] * along * along
        for k in range(leg.first_contact, leg.first_contact + leg.num_contacts):
            mass = contacts[k].mass
            along4 = dx[k]
            values = x[k] + alpha * along4
            for r in range(4):
                if values[r] < 0.0:
                    slope += mass * values[r] * along4[r]
                    curvature += mass * along4[r] * along4[r]
        return wp.vec2(slope, curvature)

    @wp.func
    def slopes_at_start(
        leg: Leg, trunk_step: TrunkMotion, contacts: wp.array(dtype=Contact), x: wp.array(dtype=vec4),
        dx: wp.array(dtype=vec4),
    ) -> wp.vec3:  # fmt: skip
        """Return a branch's slope of the whole cost along the step, and slope and curvature of its smooth part."""
        slope = wp.dot(leg.step, leg.gradient)
        slope += wp.dot(trunk_step.lin, leg.trunk_gradient_lin) + wp.dot(trunk_step.ang, leg.trunk_gradient_ang)
        curvature = wp.dot(leg.step, leg.branch.mass * leg.step)
        curvature += 2.0 * wp.dot(leg.branch.mass_lin * leg.step, trunk_step.lin)
        curvature += 2.0 * wp.dot(leg.branch.mass_ang * leg.step, trunk_step.ang)
        return wp.vec3(slope, slope - row_slopes(leg, contacts, x, dx, 0.0)[0], curvature)

    @wp.func
    def move(leg: Leg, x: wp.array(dtype=vec4), dx: wp.array(dtype=vec4), alpha: float):
        """Return a branch moved by a share of the step, and how many rows changed their state on the way."""
        flips = float(0.0)
        leg.acc = leg.acc + alpha * leg.step
        for j in range(wp.static(n)):
            mass, loss = leg.rows.friction_mass[j], leg.rows.friction_loss[j]
            old, new = leg.residuals.friction[j], leg.residuals.friction[j] + alpha * leg.change.friction[j]
            flips += wp.abs(friction_state(mass * old, loss) - friction_state(mass * new, loss))
            old_limit, new_limit = leg.residuals.limit[j], leg.residuals.limit[j] + alpha * leg.change.limit[j]
            flips += wp.where((old_limit < 0.0) != (new_limit < 0.0), 1.0, 0.0)
        leg.residuals.friction = leg.residuals.friction + alpha * leg.change.friction
        leg.residuals.limit = leg.residuals.limit + alpha * leg.change.limit
        for k in range(leg.first_contact, leg.first_contact + leg.num_contacts):
            before = x[k]
            after = before + alpha * dx[k]
            for r in range(4):
                flips += wp.where((before[r] < 0.0) != (after[r] < 0.0), 1.0, 0.0)
            x[k] = after
        return leg, flips

    return SimpleNamespace(
        Leg=Leg, start_leg=start_leg, assemble=assemble, assemble_damping=assemble_damping, eliminate=eliminate,
        branch_step=branch_step, turn_to=turn_to, slopes_at_start=slopes_at_start, row_slopes=row_slopes, move=move,
    )  # fmt: skip


@wp.func
def friction_state(force: float, loss: float) -> float:
    """Return in which of its three states a dry friction row is: -1, 0 or 1."""
    return wp.where(force <= -loss, -1.0, wp.where(force >= loss, 1.0, 0.0))
