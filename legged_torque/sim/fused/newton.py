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
from legged_torque.sim.fused.math import linear_algebra, skew, vec4, vec6


@wp.struct
class TrunkSystem:
    """Six equations for the trunk: matrix blocks and right-hand side of its translation and rotation (own axes)."""

    lin: wp.mat33
    coupling: wp.mat33  # rows translation, columns rotation
    ang: wp.mat33
    rhs_lin: wp.vec3
    rhs_ang: wp.vec3


@wp.struct
class TrunkMotion:
    """Accelerations, or a direction of search, of the trunk: translation, and rotation in its own axes."""

    lin: wp.vec3
    ang: wp.vec3


@wp.func
def solve_trunk(system: TrunkSystem) -> TrunkMotion:
    """Return the solution of the trunk's six equations."""
    a = wp.matrix(shape=(6, 6), dtype=float)
    b = vec6()
    for i in range(3):
        b[i] = system.rhs_lin[i]
        b[i + 3] = system.rhs_ang[i]
        for j in range(3):
            a[i, j] = system.lin[i, j]
            a[i + 3, j] = system.coupling[j, i]
            a[i, j + 3] = system.coupling[i, j]
            a[i + 3, j + 3] = system.ang[i, j]
    x = wp.static(linear_algebra(6).cholesky_solve)(wp.static(linear_algebra(6).cholesky)(a), b)
    out = TrunkMotion()
    out.lin = wp.vec3(x[0], x[1], x[2])
    out.ang = wp.vec3(x[3], x[4], x[5])
    return out


@wp.func
def friction_force(mass: float, loss: float, x: float) -> float:
    """Return the force of a dry friction row: as its spring says, up to the loss."""
    return wp.clamp(-mass * x, -loss, loss)


@functools.cache
def branch_newton(n: int) -> SimpleNamespace:
    """Return the types and functions of the solver for branches of ``n`` joints."""
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
    class BranchSystem:
        """The Newton equations of a branch, eliminated: what is needed to find its part of the step."""

        factor: matrix  # Cholesky factor of the Hessian's block
        coupling_lin: columns
        coupling_ang: columns
        gradient: vector
        trunk_gradient_lin: wp.vec3  # this branch's part
        trunk_gradient_ang: wp.vec3

    @wp.func
    def joint_rows_times(rows: JointRows, x: vector) -> Residuals:
        """Return J x of the joint rows."""
        out = Residuals()
        for j in range(wp.static(n)):
            out.friction[j] = x[j]
            out.limit[j] = rows.limit_sign[j] * x[j]
        return out

    @wp.func
    def contact_rows_times(
        branch: Branch, rot: wp.mat33, trunk: TrunkMotion, x: vector, normal: wp.vec3, contacts: wp.array(dtype=Contact),
        start: int, count: int, out: wp.array(dtype=vec4),
    ) -> int:  # fmt: skip
        """Write J x of the contact rows of a branch, from index ``start`` on."""
        if count > 0:
            lin = wp.zeros(shape=wp.static(n + 1), dtype=wp.vec3)
            ang = wp.zeros(shape=wp.static(n + 1), dtype=wp.vec3)
            lin[0] = trunk.lin
            ang[0] = rot * trunk.ang
            for j in range(wp.static(n)):
                lin[j + 1] = lin[j] + x[j] * column(branch.lever, j)
                ang[j + 1] = ang[j] + x[j] * column(branch.axis, j)
            for k in range(start, start + count):
                contact = contacts[k]
                motion = lin[contact.depth] + wp.cross(ang[contact.depth], contact.pos)
                out[k] = row_values(contact, normal, motion)
        return count

    @wp.func
    def eliminate(
        branch: Branch, rows: JointRows, residuals: Residuals, rot: wp.mat33, trunk_acc: TrunkMotion, acc: vector,
        normal: wp.vec3, contacts: wp.array(dtype=Contact), x: wp.array(dtype=vec4), start: int, count: int,
    ):  # fmt: skip
        """Return a branch's eliminated Newton equations and what it adds to those of the trunk."""
        out = BranchSystem()
        add = TrunkSystem()
        hessian = branch.mass
        out.coupling_lin = branch.mass_lin
        out.coupling_ang = branch.mass_ang
        out.gradient = branch.mass * acc - branch.force
        out.gradient += wp.transpose(branch.mass_lin) * trunk_acc.lin + wp.transpose(branch.mass_ang) * trunk_acc.ang
        out.trunk_gradient_lin = branch.mass_lin * acc
        out.trunk_gradient_ang = branch.mass_ang * acc
        for j in range(wp.static(n)):
            fri_mass, fri_x = rows.friction_mass[j], residuals.friction[j]
            out.gradient[j] -= friction_force(fri_mass, rows.friction_loss[j], fri_x)
            if wp.abs(fri_mass * fri_x) < rows.friction_loss[j]:
                hessian[j, j] += fri_mass
            lim_mass, lim_x = rows.limit_mass[j], residuals.limit[j]
            out.gradient[j] -= rows.limit_sign[j] * row_force(lim_mass, lim_x)
            if lim_x < 0.0:
                hessian[j, j] += lim_mass
        for k in range(start, start + count):
            contact = contacts[k]
            lever = -skew(contact.pos) * rot  # motion of the point per unit of the trunk's rotation
            jac = columns()
            for j in range(wp.static(n)):
                if j < contact.depth:
                    axis = column(branch.axis, j)
                    jac = with_column(jac, j, column(branch.lever, j) + wp.cross(axis, contact.pos))
            force = contact_force(contact, normal, x[k])
            out.gradient -= wp.transpose(jac) * force
            out.trunk_gradient_lin -= force
            out.trunk_gradient_ang -= wp.transpose(lever) * force
            stiffness = contact_stiffness(contact, normal, x[k])
            pushed = stiffness * jac
            hessian += wp.transpose(jac) * pushed
            out.coupling_lin += pushed
            out.coupling_ang += wp.transpose(lever) * pushed
            add.lin += stiffness
            add.coupling += stiffness * lever
            add.ang += wp.transpose(lever) * stiffness * lever
        out.factor = cholesky(hessian)
        add.rhs_lin = -out.trunk_gradient_lin + out.coupling_lin * cholesky_solve(out.factor, out.gradient)
        add.rhs_ang = -out.trunk_gradient_ang + out.coupling_ang * cholesky_solve(out.factor, out.gradient)
        # Schur complement, column by column of H^-1 C^T
        inv_lin = columns()
        inv_ang = columns()
        for r in range(3):
            row_lin = vector()
            row_ang = vector()
            for j in range(wp.static(n)):
                row_lin[j] = out.coupling_lin[r, j]
                row_ang[j] = out.coupling_ang[r, j]
            row_lin = cholesky_solve(out.factor, row_lin)
            row_ang = cholesky_solve(out.factor, row_ang)
            for j in range(wp.static(n)):
                inv_lin[r, j] = row_lin[j]
                inv_ang[r, j] = row_ang[j]
        add.lin -= inv_lin * wp.transpose(out.coupling_lin)
        add.coupling -= inv_lin * wp.transpose(out.coupling_ang)
        add.ang -= inv_ang * wp.transpose(out.coupling_ang)
        return out, add

    @wp.func
    def branch_step(system: BranchSystem, trunk_step: TrunkMotion) -> vector:
        """Return a branch's part of the Newton step."""
        rhs = system.gradient + wp.transpose(system.coupling_lin) * trunk_step.lin
        rhs += wp.transpose(system.coupling_ang) * trunk_step.ang
        return -cholesky_solve(system.factor, rhs)

    @wp.func
    def row_slopes(
        rows: JointRows, x: Residuals, dx: Residuals, contacts: wp.array(dtype=Contact), cx: wp.array(dtype=vec4),
        dcx: wp.array(dtype=vec4), start: int, count: int, alpha: float,
    ) -> wp.vec2:  # fmt: skip
        """Return first and second derivative of the rows' cost along a direction, at a distance ``alpha``."""
        slope = float(0.0)
        curvature = float(0.0)
        for j in range(wp.static(n)):
            mass, loss, d = rows.friction_mass[j], rows.friction_loss[j], dx.friction[j]
            value = x.friction[j] + alpha * d
            slope -= friction_force(mass, loss, value) * d
            if wp.abs(mass * value) < loss:
                curvature += mass * d * d
            d = dx.limit[j]
            value = x.limit[j] + alpha * d
            if value < 0.0:
                slope += rows.limit_mass[j] * value * d
                curvature += rows.limit_mass[j] * d * d
        for k in range(start, start + count):
            mass = contacts[k].mass
            along = dcx[k]
            values = cx[k] + alpha * along
            for r in range(4):
                if values[r] < 0.0:
                    slope += mass * values[r] * along[r]
                    curvature += mass * along[r] * along[r]
        return wp.vec2(slope, curvature)

    @wp.func
    def move_residuals(
        rows: JointRows, x: Residuals, dx: Residuals, cx: wp.array(dtype=vec4), dcx: wp.array(dtype=vec4), start: int,
        count: int, alpha: float,
    ):  # fmt: skip
        """Move along a direction; return the joint rows' new residuals and how many rows changed their state."""
        out = Residuals()
        out.friction = x.friction + alpha * dx.friction
        out.limit = x.limit + alpha * dx.limit
        changed = float(0.0)
        for j in range(wp.static(n)):
            before, after = rows.friction_mass[j] * x.friction[j], rows.friction_mass[j] * out.friction[j]
            changed += wp.abs(clamp_state(before, rows.friction_loss[j]) - clamp_state(after, rows.friction_loss[j]))
            if rows.limit_mass[j] > 0.0 and (x.limit[j] < 0.0) != (out.limit[j] < 0.0):
                changed += 1.0
        for k in range(start, start + count):
            old = cx[k]
            new = old + alpha * dcx[k]
            for r in range(4):
                if (old[r] < 0.0) != (new[r] < 0.0):
                    changed += 1.0
            cx[k] = new
        return out, changed

    return SimpleNamespace(
        Residuals=Residuals, BranchSystem=BranchSystem, joint_rows_times=joint_rows_times,
        contact_rows_times=contact_rows_times, eliminate=eliminate, branch_step=branch_step, row_slopes=row_slopes,
        move_residuals=move_residuals,
    )  # fmt: skip


@wp.func
def clamp_state(force: float, loss: float) -> float:
    """Return in which of its three states a dry friction row is: -1, 0 or 1."""
    return wp.where(force <= -loss, -1.0, wp.where(force >= loss, 1.0, 0.0))
