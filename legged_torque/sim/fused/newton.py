"""MuJoCo's Newton solver over the branches of a world: its iterations, see ``solver`` for one branch."""

import functools

import warp as wp

from legged_torque.sim.fused import constraint_self, solver
from legged_torque.sim.fused.layout import Layout, joint_counter, scratch_type, storage
from legged_torque.sim.fused.math import cholesky, group_sum, group_sum3, sync_group
from legged_torque.sim.fused.model import Model
from legged_torque.sim.fused.trunk import (
    TrunkMotion,
    TrunkSystem,
    WholeBody,
    solve_trunk,
    trunk_matrix,
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
def assembler(layout: Layout) -> wp.Function:
    """Return ``assemble``."""
    threads, per_thread, store, num_joints = layout.threads, layout.per_thread, storage(layout), joint_counter(layout)
    Scratch = scratch_type(layout)

    @wp.func
    def assemble(
        model: Model, scratch: Scratch, world: int, thread: int, branch: AnyBranch, rot: wp.mat33, acc: TrunkMotion
    ):
        """Assemble and eliminate the branches' Newton equations.

        Return also what is left for the trunk, and what they add to the trunk's equations before the elimination.
        """
        system, whole = TrunkSystem(), TrunkSystem()
        for i in range(wp.static(per_thread)):
            b = thread + i * wp.static(threads)
            branch = store.load(scratch, world, i, branch)
            if store.owns(thread, i):
                branch, add = solver.assemble(branch, rot, acc, scratch.contacts)
                if wp.static(bool(layout.self_kinds)):
                    joints = num_joints(model, b)
                    branch = constraint_self.push_branch(model, scratch.selves, world, b, joints, branch)
                    if scratch.selves.coupled:
                        constraint_self.show_equations(model, scratch.selves, world, b, joints, branch)
                        whole = solver.add_whole(branch, whole, add)
                branch.factor = cholesky(branch.factor)
                system = solver.eliminate(branch, system, add)
            store.store(scratch, world, i, branch)
        return branch, system, whole

    return assemble


@functools.cache
def coupler(layout: Layout) -> wp.Function:
    """Return ``couple``."""
    threads, Scratch = layout.threads, scratch_type(layout)
    solve_system = constraint_self.system_solver(threads)

    @wp.func
    def couple(
        scratch: Scratch,
        world: int,
        thread: int,
        whole: WholeBody,
        residual: TrunkMotion,
        added: TrunkSystem,
        step: TrunkMotion,
    ) -> TrunkMotion:
        """Return the trunk's step: another one if contacts couple branches, whose steps are then kept as well.

        ``added`` is what the branches add to the trunk's equations.
        """
        if wp.static(bool(layout.self_kinds)):  # noqa: SIM102 - this decides what is compiled
            if scratch.selves.coupled:
                lin = group_sum3(added.rhs_lin, wp.static(threads)) - residual.lin
                ang = group_sum3(added.rhs_ang, wp.static(threads)) - residual.ang
                matrix = trunk_matrix(whole, added, wp.static(threads))
                if thread == 0:
                    constraint_self.show_trunk_equations(scratch.selves, world, matrix, lin, ang)
                step = solve_system(scratch.selves, world, thread)
        return step

    return couple


@functools.cache
def stepper(layout: Layout) -> wp.Function:
    """Return ``find_step``."""
    threads, per_thread, store, num_joints = layout.threads, layout.per_thread, storage(layout), joint_counter(layout)
    Scratch = scratch_type(layout)

    @wp.func
    def find_step(
        model: Model, scratch: Scratch, world: int, thread: int, branch: AnyBranch, rot: wp.mat33, step: TrunkMotion
    ):
        """Find the branches' parts of the step; return also their slopes of the cost along it."""
        slopes = wp.vec3(0.0)
        for i in range(wp.static(per_thread)):
            b = thread + i * wp.static(threads)
            branch = store.load(scratch, world, i, branch)
            if store.owns(thread, i):
                branch.step = solver.branch_step(branch, step)
                if wp.static(bool(layout.self_kinds)):
                    joints = num_joints(model, b)
                    if scratch.selves.coupled:
                        branch.step = constraint_self.coupled_step(model, scratch.selves, world, b, joints, branch.step)
                    constraint_self.show_joints(model, scratch.selves, world, b, joints, branch.step)
                branch, of_rows = solver.along_step(branch, rot, step, scratch.contacts)
                slopes += solver.slopes_at_start(branch, step, of_rows)
            store.store(scratch, world, i, branch)
        if wp.static(bool(layout.self_kinds)):
            sync_group(wp.static(threads))
            slopes[1] -= constraint_self.along_step(scratch.selves, world, thread, wp.static(threads))
        return branch, group_sum3(slopes, wp.static(threads))

    return find_step


@functools.cache
def line_searcher(layout: Layout) -> wp.Function:
    """Return ``line_search``."""
    threads, per_thread, store, Scratch = layout.threads, layout.per_thread, storage(layout), scratch_type(layout)

    @wp.func
    def line_search(
        scratch: Scratch,
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
            for i in range(wp.static(per_thread)):
                branch = store.load(scratch, world, i, branch)
                slopes += solver.row_slopes(branch, scratch.contacts, alpha)
            if wp.static(bool(layout.self_kinds)):
                for k in range(scratch.selves.first + thread, scratch.selves.end, wp.static(threads)):
                    slopes = solver.add_contact_slopes(slopes, scratch.selves, k, alpha)
            slope = at_start[1] + alpha * at_start[2] + group_sum(slopes[0], wp.static(threads))
            curvature = at_start[2] + group_sum(slopes[1], wp.static(threads))
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

    return line_search


@functools.cache
def mover(layout: Layout) -> wp.Function:
    """Return ``move``."""
    threads, per_thread, store, Scratch = layout.threads, layout.per_thread, storage(layout), scratch_type(layout)

    @wp.func
    def move(scratch: Scratch, world: int, thread: int, branch: AnyBranch, alpha: float):
        """Move the branches along the step; return also how many rows of the world changed their state."""
        flips = float(0.0)
        for i in range(wp.static(per_thread)):
            branch = store.load(scratch, world, i, branch)
            branch, changed = solver.move(branch, scratch.contacts, alpha)
            flips += changed
            store.store(scratch, world, i, branch)
        if wp.static(bool(layout.self_kinds)):
            for k in range(scratch.selves.first + thread, scratch.selves.end, wp.static(threads)):
                flips += solver.move_contact(scratch.selves, k, alpha)
            sync_group(wp.static(threads))
        return branch, group_sum(flips, wp.static(threads))

    return move


@functools.cache
def newton_solver(layout: Layout) -> wp.Function:
    """Return ``solve``."""
    assemble, couple, find_step = assembler(layout), coupler(layout), stepper(layout)
    line_search, move, Scratch, threads = line_searcher(layout), mover(layout), scratch_type(layout), layout.threads

    @wp.func
    def solve(
        model: Model,
        scratch: Scratch,
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
            if wp.static(bool(layout.self_kinds)):
                scratch.selves = constraint_self.with_coupling(scratch.selves)
            branch, system, added = assemble(model, scratch, world, thread, branch, rot, acc)
            residual = trunk_residual(whole, acc)
            step = solve_trunk(whole, residual, system, wp.static(threads))
            step = couple(scratch, world, thread, whole, residual, added, step)
            branch, slopes = find_step(model, scratch, world, thread, branch, rot, step)
            start = slopes + trunk_slopes(whole, residual, step)
            decrease = -start[0] * model.cost_scale
            if used > 1 and not (decrease > model.tolerance):
                break
            tolerance = wp.where(used > 1, LINE_SEARCH_TOLERANCE, FIRST_TOLERANCE)
            alpha = line_search(scratch, world, thread, branch, start, tolerance, model.ls_iterations)
            acc.lin = acc.lin + alpha * step.lin
            acc.ang = acc.ang + alpha * step.ang
            branch, flips = move(scratch, world, thread, branch, alpha)
            if alpha == 1.0 and flips == 0.0 and decrease < EXACT_STEP:
                break  # the whole step stayed in one piece of the piecewise quadratic cost: this is its minimum
        return branch, acc, used

    return solve
