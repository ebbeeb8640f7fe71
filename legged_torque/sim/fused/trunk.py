"""The six equations of the trunk that remain when all branches are eliminated."""

import warp as wp

from legged_torque.sim.fused.math import (
    cholesky,
    cholesky_solve,
    group_sum,
    group_sum3,
    group_sum33,
    group_sum33_symmetric,
)
from legged_torque.sim.fused.model import State
from legged_torque.sim.fused.types import Body, Trunk, mat66, vec6


@wp.struct
class WholeBody:
    """Inertia and bias of the trunk's translation (world axes) and rotation (its own axes), with all branches."""

    mass: wp.float32
    coupling: wp.mat33  # rows translation, columns rotation
    rotation: wp.mat33
    bias_lin: wp.vec3
    bias_ang: wp.vec3


@wp.struct
class TrunkMotion:
    """Accelerations, or a direction of search, of the trunk: translation (world axes), rotation (its own axes)."""

    lin: wp.vec3
    ang: wp.vec3


@wp.struct
class TrunkSystem:
    """Six equations for the trunk's step: matrix blocks and right-hand sides."""

    lin: wp.mat33
    coupling: wp.mat33  # rows translation, columns rotation
    ang: wp.mat33
    rhs_lin: wp.vec3
    rhs_ang: wp.vec3


@wp.func
def warm_start(state: State, world: int) -> TrunkMotion:
    """Return the trunk's accelerations at the start of the solver."""
    qacc = state.qacc_warmstart
    out = TrunkMotion()
    out.lin = wp.vec3(qacc[world, 0], qacc[world, 1], qacc[world, 2])
    out.ang = wp.vec3(qacc[world, 3], qacc[world, 4], qacc[world, 5])
    return out


@wp.func
def whole_inertia(trunk: Trunk, branches: Body, threads: int) -> WholeBody:
    """Return the inertia of the trunk with its branches, from the sum over the branches of this thread; no bias."""
    out = WholeBody()
    moment = trunk.body.moment + group_sum3(branches.moment, threads)
    inertia = trunk.body.inertia + group_sum33_symmetric(branches.inertia, threads)
    out.mass = trunk.body.mass + group_sum(branches.mass, threads)
    out.coupling = -wp.skew(moment) * trunk.rot
    out.rotation = wp.transpose(trunk.rot) * inertia * trunk.rot
    return out


@wp.func
def whole_body(trunk: Trunk, branches: Body, threads: int) -> WholeBody:
    """Return the equations of the trunk with its branches, from the sum over the branches of this thread."""
    out = whole_inertia(trunk, branches, threads)
    torque = trunk.body.torque + group_sum3(branches.torque, threads)
    out.bias_lin = trunk.body.force + group_sum3(branches.force, threads)
    out.bias_ang = wp.transpose(trunk.rot) * torque
    return out


@wp.func
def trunk_residual(whole: WholeBody, acc: TrunkMotion) -> TrunkMotion:
    """Return M a + bias of the trunk, without the terms of the branches' accelerations."""
    out = TrunkMotion()
    out.lin = whole.mass * acc.lin + whole.coupling * acc.ang + whole.bias_lin
    out.ang = wp.transpose(whole.coupling) * acc.lin + whole.rotation * acc.ang + whole.bias_ang
    return out


@wp.func
def trunk_slopes(whole: WholeBody, residual: TrunkMotion, step: TrunkMotion) -> wp.vec3:
    """Return the slope of the trunk's cost along a step, the same of its smooth part, and the curvature."""
    slope = wp.dot(step.lin, residual.lin) + wp.dot(step.ang, residual.ang)
    curvature = whole.mass * wp.dot(step.lin, step.lin) + 2.0 * wp.dot(step.lin, whole.coupling * step.ang)
    return wp.vec3(slope, slope, curvature + wp.dot(step.ang, whole.rotation * step.ang))


@wp.func
def trunk_matrix(whole: WholeBody, branches: TrunkSystem, threads: int) -> mat66:
    """Return the matrix of the trunk's equations, from the terms of this thread's branches."""
    lin = group_sum33_symmetric(branches.lin, threads) + whole.mass * wp.identity(n=3, dtype=float)
    coupling = group_sum33(branches.coupling, threads) + whole.coupling
    ang = group_sum33_symmetric(branches.ang, threads) + whole.rotation
    a = mat66()
    for i in range(3):
        for j in range(3):
            a[i, j] = lin[i, j]
            a[i + 3, j] = coupling[j, i]
            a[i, j + 3] = coupling[i, j]
            a[i + 3, j + 3] = ang[i, j]
    return a


@wp.func
def solve_trunk(whole: WholeBody, residual: TrunkMotion, branches: TrunkSystem, threads: int) -> TrunkMotion:
    """Return the trunk's Newton step, from the terms of this thread's branches."""
    lin = group_sum3(branches.rhs_lin, threads) - residual.lin
    ang = group_sum3(branches.rhs_ang, threads) - residual.ang
    factor = cholesky(trunk_matrix(whole, branches, threads))
    x = cholesky_solve(factor, vec6(lin[0], lin[1], lin[2], ang[0], ang[1], ang[2]))
    out = TrunkMotion()
    out.lin = wp.vec3(x[0], x[1], x[2])
    out.ang = wp.vec3(x[3], x[4], x[5])
    return out
