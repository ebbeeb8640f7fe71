"""Constraint rows of contacts between parts of a robot.

Such a contact does not act on the trunk's six equations, since both its bodies move along with the trunk. Within one
branch, or with the trunk, it adds to the branch's block of the Hessian. Between two branches it couples their blocks,
so that they cannot be eliminated one by one: then all threads of the world factor its whole system together.
"""

import warp as wp

from legged_torque.sim.fused.collision_self import SelfContacts, Touching, pair_params
from legged_torque.sim.fused.constraint import contact_force, contact_stiffness, expected_rows, row_values, with_rows
from legged_torque.sim.fused.math import column, group_sum, group_sum3, inverse_sqrt, sync_group, with_column
from legged_torque.sim.fused.model import Model, State
from legged_torque.sim.fused.trunk import TrunkMotion, TrunkSystem, WholeBody, trunk_matrix
from legged_torque.sim.fused.types import AnyBranch, AnyVector


@wp.func
def hinge_index(model: Model, b: int, j: int) -> int:
    """Return the index of a branch's joint among all hinges."""
    return model.branch_joint[b, j] - 1


@wp.func
def write_joints(model: Model, selves: SelfContacts, world: int, b: int, joints: int, values: AnyVector):
    """Write the step of a branch's joints for the other threads of its world."""
    for j in range(len(values)):
        if j < joints:
            selves.joints[world, hinge_index(model, b, j)] = values[j]


@wp.func
def write_jacobians(
    model: Model, selves: SelfContacts, touching: Touching, world: int, b: int, joints: int, branch: AnyBranch
):
    """Write the columns of a branch's joints in the Jacobians of all contacts of its world."""
    for k in range(touching.first, touching.end):
        geoms = selves.pair[selves.of_pair[k]]
        first, second = selves.geom_place[geoms[0]], selves.geom_place[geoms[1]]
        for j in range(len(branch.acc)):
            if j < joints:
                motion = column(branch.smooth.lever, j) + wp.cross(column(branch.smooth.axis, j), selves.found[k].pos)
                sign = wp.where(second[0] == b and j < second[1], 1.0, 0.0)
                sign -= wp.where(first[0] == b and j < first[1], 1.0, 0.0)
                selves.jacobian[k, hinge_index(model, b, j)] = sign * motion


@wp.func
def motion_at(selves: SelfContacts, values: wp.array2d(dtype=wp.float32), first: int, world: int, k: int) -> wp.vec3:
    """Return the motion of a contact's second body less that of its first, for values of all joints from ``first`` on.

    The trunk moves both alike.
    """
    motion = wp.vec3(0.0)
    for c in range(selves.joints.shape[1]):
        motion += values[world, first + c] * selves.jacobian[k, c]
    return motion


@wp.func
def start_rows(
    model: Model, state: State, selves: SelfContacts, touching: Touching, world: int, thread: int, threads: int
):
    """Write the rows of a thread's contacts, their residuals at the start, and which of them are expected to push."""
    for k in range(touching.first + thread, touching.end, threads):
        pair, normal = selves.of_pair[k], selves.normal[k]
        velocity, acc = motion_at(selves, state.qvel, 6, world, k), motion_at(selves, state.qacc_warmstart, 6, world, k)
        params, geoms = pair_params(model, selves, world, pair), selves.pair[pair]
        contact = with_rows(model, world, geoms, params, selves.dist[k], velocity, normal, selves.found[k])
        selves.found[k] = contact
        selves.residual[k] = row_values(contact, normal, acc) - contact.reference
        selves.pushing[k] = expected_rows(contact)


@wp.func
def along_step(selves: SelfContacts, touching: Touching, world: int, thread: int, threads: int) -> float:
    """Write the changes of the residuals of a thread's contacts along the step, and return the slope of their cost."""
    slope = float(0.0)
    for k in range(touching.first + thread, touching.end, threads):
        selves.change[k] = row_values(selves.found[k], selves.normal[k], motion_at(selves, selves.joints, 0, world, k))
        pushing = wp.cw_mul(selves.pushing[k], selves.residual[k])
        slope += selves.found[k].mass * wp.dot(pushing, selves.change[k])
    return slope


@wp.func
def with_coupling(selves: SelfContacts, touching: Touching) -> Touching:
    """Return a world's contacts, marked as coupled if one between two branches pushes."""
    touching.coupled = False
    for k in range(touching.first, touching.end):
        geoms = selves.pair[selves.of_pair[k]]
        first, second = selves.geom_place[geoms[0]], selves.geom_place[geoms[1]]
        if first[0] != second[0] and first[1] > 0 and second[1] > 0 and wp.length_sq(selves.pushing[k]) > 0.0:
            touching.coupled = True
    return touching


@wp.func
def add_to_branch(
    model: Model, selves: SelfContacts, touching: Touching, world: int, b: int, joints: int, branch: AnyBranch
):
    """Return a branch with the contacts' terms in its gradient and its block of the Hessian."""
    for k in range(touching.first, touching.end):
        force = contact_force(selves.found[k], selves.normal[k], selves.residual[k], selves.pushing[k])
        stiffness = contact_stiffness(selves.found[k], selves.normal[k], selves.pushing[k])
        jacobian = type(branch.coupling_lin)()
        for j in range(len(branch.acc)):
            if j < joints:
                jacobian = with_column(jacobian, j, selves.jacobian[k, hinge_index(model, b, j)])
        pushed = stiffness * jacobian
        branch.gradient -= wp.transpose(jacobian) * force
        branch.factor += wp.transpose(jacobian) * pushed
        for j in range(len(branch.acc)):
            if j < joints:
                selves.pushed[k, hinge_index(model, b, j)] = column(pushed, j)
    return branch


@wp.func
def write_equations(
    model: Model, selves: SelfContacts, touching: Touching, world: int, b: int, joints: int, branch: AnyBranch
):
    """Write a branch's equations into the whole system: its rows, its columns in the trunk's, its right-hand side.

    The system has the joints first, then the trunk's translation and rotation; its last row is the right-hand side.
    Rows end at the diagonal.
    """
    size = selves.matrix.shape[2]
    for j in range(len(branch.acc)):
        if j < joints:
            row = hinge_index(model, b, j)
            for c in range(row):
                entry = float(0.0)
                for k in range(touching.first, touching.end):
                    entry += wp.dot(selves.pushed[k, row], selves.jacobian[k, c])
                selves.matrix[world, row, c] = entry
            for i in range(len(branch.acc)):
                if i < joints:
                    selves.matrix[world, row, hinge_index(model, b, i)] = branch.factor[j, i]
            for r in range(3):
                selves.matrix[world, size - 6 + r, row] = branch.coupling_lin[r, j]
                selves.matrix[world, size - 3 + r, row] = branch.coupling_ang[r, j]
            selves.matrix[world, size, row] = -branch.gradient[j]


@wp.func
def coupled_step(model: Model, selves: SelfContacts, world: int, b: int, joints: int, step: AnyVector):
    """Return a branch's part of the solution of the whole system."""
    for j in range(len(step)):
        if j < joints:
            step[j] = selves.matrix[world, selves.matrix.shape[2], hinge_index(model, b, j)]
    return step


@wp.func
def left_over(selves: SelfContacts, world: int, r: int, c: int) -> float:
    """Return an entry of the whole system less what the columns before it explain.

    It only reads, so that a thread waits for memory once, not for each entry.
    """
    rest = selves.matrix[world, r, c]
    for k in range(c):
        rest -= selves.matrix[world, r, k] * selves.matrix[world, c, k]
    return rest


@wp.func
def factor_system(selves: SelfContacts, world: int, thread: int, threads: int):
    """Write a world's Cholesky factor in place of its whole system, with the inverse of its diagonal.

    Each thread has every so many rows. The right-hand side is one more row.
    """
    size = selves.matrix.shape[2]
    for c in range(size):
        sync_group(threads)
        first, pivot = c + thread, float(0.0)
        rest = float(0.0)
        if first <= size:
            rest = left_over(selves, world, first, c)
        if thread == 0:
            pivot = rest
        inverse = inverse_sqrt(wp.max(group_sum(pivot, threads), 1.0e-12))
        for r in range(first + threads, size + 1, threads):
            selves.matrix[world, r, c] = inverse * left_over(selves, world, r, c)
        if first <= size:
            selves.matrix[world, first, c] = wp.where(thread == 0, inverse, inverse * rest)


@wp.func
def substitute(selves: SelfContacts, world: int, thread: int, threads: int):
    """Write the solution of the whole system in place of its right-hand side, after its factorization."""
    size = selves.matrix.shape[2]
    for reverse in range(size):
        c = size - 1 - reverse
        known = float(0.0)
        for r in range(size - 1 - thread, c, -threads):  # whose solutions this thread has written
            known += selves.matrix[world, r, c] * selves.matrix[world, size, r]
        x = selves.matrix[world, c, c] * (selves.matrix[world, size, c] - group_sum(known, threads))
        if reverse % threads == thread:
            selves.matrix[world, size, c] = x


@wp.func
def solve_system(
    selves: SelfContacts,
    world: int,
    thread: int,
    threads: int,
    whole: WholeBody,
    residual: TrunkMotion,
    added: TrunkSystem,
) -> TrunkMotion:
    """Solve a world's whole system; return the trunk's step and leave all in the last row.

    ``added`` is what the branches add to the trunk's equations.
    """
    size = selves.matrix.shape[2]
    lin = group_sum3(added.rhs_lin, threads) - residual.lin
    ang = group_sum3(added.rhs_ang, threads) - residual.ang
    of_trunk = trunk_matrix(whole, added, threads)
    if thread == 0:
        for i in range(6):
            for j in range(6):
                selves.matrix[world, size - 6 + i, size - 6 + j] = of_trunk[i, j]
        for i in range(3):
            selves.matrix[world, size, size - 6 + i] = lin[i]
            selves.matrix[world, size, size - 3 + i] = ang[i]
    factor_system(selves, world, thread, threads)
    sync_group(threads)
    substitute(selves, world, thread, threads)
    sync_group(threads)
    step = TrunkMotion()
    for r in range(3):
        step.lin[r] = selves.matrix[world, size, size - 6 + r]
        step.ang[r] = selves.matrix[world, size, size - 3 + r]
    return step
