"""The iterations of MuJoCo's Newton solver, over the branches of a thread; see ``solver`` for one branch."""

import functools

import warp as wp

from legged_torque.sim.fused import constraint_self, solver
from legged_torque.sim.fused.collision_self import Touching
from legged_torque.sim.fused.layout import Layout, branches_of
from legged_torque.sim.fused.math import cholesky, group_sum, group_sum3, sync_group
from legged_torque.sim.fused.model import Model
from legged_torque.sim.fused.trunk import (
    TrunkMotion,
    TrunkSystem,
    WholeBody,
    solve_trunk,
    trunk_residual,
    trunk_slopes,
)
from legged_torque.sim.fused.types import AnyBranch

EXACT_STEP = wp.constant(1.0)
"""A step that promises less than this decrease of the cost, in MuJoCo's units, is exact in float32 for our purposes."""
LINE_SEARCH_TOLERANCE = wp.constant(0.1)
FIRST_TOLERANCE = wp.constant(5.0)
"""The line search stops when the slope has come down to this share of its value at the start. In the first iteration,
whose step leads to where the cost is least with the expected rows, it is only cut short if it is absurd."""


@functools.cache
def step_finder(layout: Layout) -> tuple[wp.Function, wp.Function]:
    """Return ``assemble`` and ``find_step``: before and after the trunk's part of the Newton step is known."""
    own = branches_of(layout)

    @wp.func
    def assemble(
        model: Model,
        scratch: own.Scratch,
        touching: Touching,
        world: int,
        thread: int,
        branch: AnyBranch,
        rot: wp.mat33,
        acc: TrunkMotion,
    ):
        """Assemble and eliminate the branches' Newton equations.

        Return also the terms that they leave for the trunk, and their terms for the trunk before the elimination.
        """
        system, whole = TrunkSystem(), TrunkSystem()
        for i in range(wp.static(own.per_thread)):
            b = thread + i * wp.static(own.threads)
            branch = own.load(scratch, world, i, branch)
            if own.owns(thread, i):
                branch, add = solver.assemble(branch, rot, acc, scratch.contacts)
                if wp.static(own.collide):
                    joints = own.num_joints(model, b)
                    branch = constraint_self.add_to_branch(model, scratch.selves, touching, world, b, joints, branch)
                    if touching.coupled:
                        constraint_self.write_equations(model, scratch.selves, touching, world, b, joints, branch)
                        whole = solver.add_whole(branch, whole, add)
                branch.factor = cholesky(branch.factor)
                system = solver.eliminate(branch, system, add)
            own.store(scratch, world, i, branch)
        return branch, system, whole

    @wp.func
    def find_step(
        model: Model,
        scratch: own.Scratch,
        touching: Touching,
        world: int,
        thread: int,
        branch: AnyBranch,
        rot: wp.mat33,
        step: TrunkMotion,
    ):
        """Find the branches' parts of the step; return also their slopes of the cost along it."""
        slopes = wp.vec3(0.0)
        for i in range(wp.static(own.per_thread)):
            b = thread + i * wp.static(own.threads)
            branch = own.load(scratch, world, i, branch)
            if own.owns(thread, i):
                branch.step = solver.branch_step(branch, step)
                if wp.static(own.collide):
                    joints = own.num_joints(model, b)
                    if touching.coupled:
                        branch.step = constraint_self.coupled_step(model, scratch.selves, world, b, joints, branch.step)
                    constraint_self.write_joints(model, scratch.selves, world, b, joints, branch.step)
                branch, of_rows = solver.along_step(branch, rot, step, scratch.contacts)
                slopes += solver.slopes_at_start(branch, step, of_rows)
            own.store(scratch, world, i, branch)
        if wp.static(own.collide):
            sync_group(wp.static(own.threads))
            slopes[1] -= constraint_self.along_step(scratch.selves, touching, world, thread, wp.static(own.threads))
        return branch, group_sum3(slopes, wp.static(own.threads))

    return assemble, find_step


@functools.cache
def line_searcher(layout: Layout) -> tuple[wp.Function, wp.Function]:
    """Return ``line_search`` and ``move``: along the step."""
    own = branches_of(layout)

    @wp.func
    def line_search(
        scratch: own.Scratch,
        touching: Touching,
        world: int,
        thread: int,
        branch: AnyBranch,
        at_start: wp.vec3,
        tolerance: float,
        iterations: int,
    ) -> float:
        """Return the share of the step at which the cost is least: Newton's method, kept between bounds."""
        alpha = float(1.0)
        low = float(0.0)
        high = float(0.0)
        for _search in range(iterations):
            slopes = wp.vec2(0.0, 0.0)
            for i in range(wp.static(own.per_thread)):
                branch = own.load(scratch, world, i, branch)
                slopes += solver.row_slopes(branch, scratch.contacts, alpha)
            if wp.static(own.collide):
                for k in range(touching.first + thread, touching.end, wp.static(own.threads)):
                    slopes = solver.add_contact_slopes(slopes, scratch.selves, k, alpha)
            slope = at_start[1] + alpha * at_start[2] + group_sum(slopes[0], wp.static(own.threads))
            curvature = at_start[2] + group_sum(slopes[1], wp.static(own.threads))
            if wp.abs(slope) <= tolerance * wp.abs(at_start[0]):
                break
            if slope < 0.0:
                low = alpha
            else:
                high = alpha
            alpha -= slope / curvature
            if high > 0.0 and (alpha <= low or alpha >= high):
                alpha = 0.5 * (low + high)
        return alpha

    @wp.func
    def move(scratch: own.Scratch, touching: Touching, world: int, thread: int, branch: AnyBranch, alpha: float):
        """Move the branches along the step; return also how many rows of the world changed their state."""
        flips = float(0.0)
        for i in range(wp.static(own.per_thread)):
            branch = own.load(scratch, world, i, branch)
            branch, changed = solver.move(branch, scratch.contacts, alpha)
            flips += changed
            own.store(scratch, world, i, branch)
        if wp.static(own.collide):
            for k in range(touching.first + thread, touching.end, wp.static(own.threads)):
                flips += solver.move_contact(scratch.selves, k, alpha)
            sync_group(wp.static(own.threads))
        return branch, group_sum(flips, wp.static(own.threads))

    return line_search, move


@functools.cache
def newton_solver(layout: Layout) -> wp.Function:
    """Return ``solve``."""
    own, (assemble, find_step), (line_search, move) = branches_of(layout), step_finder(layout), line_searcher(layout)

    @wp.func
    def solve(
        model: Model,
        scratch: own.Scratch,
        touching: Touching,
        world: int,
        thread: int,
        whole: WholeBody,
        branch: AnyBranch,
        rot: wp.mat33,
        acc: TrunkMotion,
    ):
        """Return branches and trunk with the accelerations of the least cost, and how many iterations that took."""
        used = int(0)
        for _iteration in range(model.iterations):
            used += 1
            if wp.static(own.collide):
                touching = constraint_self.with_coupling(scratch.selves, touching)
            branch, system, added = assemble(model, scratch, touching, world, thread, branch, rot, acc)
            residual = trunk_residual(whole, acc)
            step = solve_trunk(whole, residual, system, wp.static(own.threads))
            if wp.static(own.collide):  # noqa: SIM102 - this decides what is compiled
                if touching.coupled:
                    step = constraint_self.solve_system(
                        scratch.selves, world, thread, wp.static(own.threads), whole, residual, added
                    )
            branch, slopes = find_step(model, scratch, touching, world, thread, branch, rot, step)
            start = slopes + trunk_slopes(whole, residual, step)
            decrease = -start[0] * model.cost_scale
            if used > 1 and not (decrease > model.tolerance):
                break
            tolerance = wp.where(used > 1, LINE_SEARCH_TOLERANCE, FIRST_TOLERANCE)
            alpha = line_search(scratch, touching, world, thread, branch, start, tolerance, model.ls_iterations)
            acc.lin = acc.lin + alpha * step.lin
            acc.ang = acc.ang + alpha * step.ang
            branch, flips = move(scratch, touching, world, thread, branch, alpha)
            if alpha == 1.0 and flips == 0.0 and decrease < EXACT_STEP:
                break  # the whole step stayed in one piece of the piecewise quadratic cost: this is its minimum
        return branch, acc, used

    return solve
