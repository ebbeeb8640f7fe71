"""The parts of a step over all branches of a thread: its one branch on a GPU, a world's all on a CPU.

On a GPU the branch stays in registers: it is handed from function to function as ``branch``. On a CPU the array
``kept`` holds the branches of the worlds while others have their turn, see :func:`places`.
"""

import functools
from types import SimpleNamespace
from typing import Any, NamedTuple

import warp as wp

from legged_torque.sim.fused import self_rows, solver
from legged_torque.sim.fused.applied import apply_to_branch
from legged_torque.sim.fused.constraint import make_joint_rows
from legged_torque.sim.fused.contact import find_contacts
from legged_torque.sim.fused.integrate import integrate_branch, sense_branch, sense_self_contacts
from legged_torque.sim.fused.map_contact import MAX_TOUCHES, find_map_contacts
from legged_torque.sim.fused.math import cholesky, group_sum, group_sum3, sync_group
from legged_torque.sim.fused.self_contact import SelfContacts, finder
from legged_torque.sim.fused.smooth import Pose, add_bodies, links_maker, make_equations
from legged_torque.sim.fused.tables import Tables, Worlds, dof, qadr
from legged_torque.sim.fused.tree import Tree
from legged_torque.sim.fused.trunk import TrunkMotion, TrunkSystem, WholeBody, trunk_matrix
from legged_torque.sim.fused.types import AnyBranch, AnyContacts, Body, Trunk, branch_types

LINE_SEARCH_TOLERANCE = wp.constant(0.1)
FIRST_TOLERANCE = wp.constant(5.0)
"""The line search stops when the slope has come down to this share of that at its start; likewise in the first
iteration, whose step leads to where the cost is least with the expected rows: it is only cut short if it is absurd."""


class Layout(NamedTuple):
    """What a kernel is made for: a robot's structure, and how its branches are spread over threads."""

    branches: int
    depth: int  # most joints of a branch
    points: int  # most contacts of a branch with the floor
    lanes: int  # threads per world, a power of two; 1 on a CPU
    on_map: bool  # whether the ground is a height map, not a plane
    alike: bool  # whether all branches have ``depth`` joints; else some have fewer
    cylinders: bool  # whether any of its geoms is one
    self_kinds: tuple[tuple[int, int], ...]  # types of pairs of geoms on the robot that may touch each other

    @classmethod
    def of(
        cls, tree: Tree, on_gpu: bool, on_map: bool = False, self_kinds: tuple[tuple[int, int], ...] = ()
    ) -> "Layout":
        """Return a robot's layout: on a GPU a thread per branch, rounded up to a power of two, else one per world."""
        branches, depth = tree.joints.shape
        points = tree.most_points * (MAX_TOUCHES if on_map else 1)
        lanes, alike = 1 << (branches - 1).bit_length() if on_gpu else 1, bool((tree.joints >= 0).all())
        return cls(branches, depth, points, lanes, on_map, alike, tree.has_cylinders, self_kinds)

    @property
    def per_lane(self) -> int:
        """Most branches of a thread."""
        return -(-self.branches // self.lanes)

    @property
    def selves_type(self) -> Any:
        """Type of what a kernel is given for contacts between parts of a robot: a number if there are none."""
        return SelfContacts if self.self_kinds else wp.int32


@functools.cache
def joint_counter(layout: Layout) -> wp.Function:
    """Return a function for the number of a branch's joints: a constant where all are alike, so that nothing masks."""
    depth, alike = layout.depth, layout.alike

    @wp.func
    def num_joints(tables: Tables, b: int) -> int:
        if wp.static(alike):
            return wp.static(depth)
        return tables.joint_count[b]

    return num_joints


@functools.cache
def places(layout: Layout) -> SimpleNamespace:
    """Return how threads keep their branches: ``take`` and ``keep`` the one number ``i`` of a thread, if it ``has`` it.

    A thread that has only one keeps it in registers: both do nothing.
    """
    branches, lanes, per_lane = layout.branches, layout.lanes, layout.per_lane

    @wp.func
    def has(lane: int, i: int) -> bool:
        # What is known beforehand saves moves and spills: a quarter of the solver's instructions.
        return wp.static(branches == lanes * per_lane) or lane + i * wp.static(lanes) < wp.static(branches)

    @wp.func
    def take(kept: wp.array(dtype=AnyBranch), world: int, i: int, branch: AnyBranch):
        if wp.static(per_lane > 1):
            branch = kept[world * wp.static(per_lane) + i]
        return branch

    @wp.func
    def keep(kept: wp.array(dtype=AnyBranch), world: int, i: int, branch: AnyBranch):
        if wp.static(per_lane > 1):
            kept[world * wp.static(per_lane) + i] = branch

    return SimpleNamespace(has=has, take=take, keep=keep)


@functools.cache
def around_solver(layout: Layout, applied_forces: bool, law: wp.Function | None) -> SimpleNamespace:
    """Return what comes before and after the solver, in this order: the functions with these names.

    That is ``drive_all``, ``make_all``, ``meet_all``, ``damp_all`` and ``integrate_all``.
    ``applied_forces`` says whether there are forces that a user applies, ``law`` what computes torques, if anything.
    """
    branches, depth, points, lanes, on_map, _, cylinders, self_kinds = layout
    per_lane, place, num_joints = layout.per_lane, places(layout), joint_counter(layout)
    find = find_map_contacts if on_map else find_contacts
    Branch, make_links = branch_types(depth).Branch, links_maker(depth)
    Kept, Selves, meets_itself = wp.array(dtype=Branch), layout.selves_type, bool(self_kinds)
    find_self_contacts = finder(self_kinds, lanes)

    @wp.func
    def drive_all(tables: Tables, worlds: Worlds, world: int, lane: int, step: int, reads: Any):
        """Write the torques of the branches' motors in a step of this launch; without a law they are there already."""
        if wp.static(law is not None):
            for i in range(wp.static(per_lane)):
                b = lane + i * wp.static(lanes)
                if place.has(lane, i):
                    for j in range(wp.static(depth)):
                        joint = tables.branch_joint[b, j]
                        motor = tables.branch_actuator[b, j]
                        if motor >= 0:
                            pos = worlds.qpos[world, qadr(joint)]
                            vel = worlds.qvel[world, dof(joint)]
                            worlds.ctrl[world, motor] = law(reads, world, motor, step, pos, vel)

    @wp.func
    def make_branch(
        tables: Tables, worlds: Worlds, world: int, b: int, trunk: Trunk, contacts: AnyContacts, selves: Selves
    ) -> Branch:
        """Return a branch with its equations of motion, constraints and the accelerations to start from."""
        poses = wp.zeros(shape=wp.static(depth + 1), dtype=Pose)
        joints = num_joints(tables, b)
        branch, links = make_links(tables, worlds, world, b, joints, trunk, poses)
        if wp.static(applied_forces):
            branch, links = apply_to_branch(branch, links, tables, worlds, world, b, joints, poses)
        branch = make_equations(branch, links, tables, world, b, joints, trunk.rot)
        branch.rows = make_joint_rows(branch.rows, tables, worlds, world, b, joints)
        branch.first_contact = (world * wp.static(branches) + b) * wp.static(points)
        branch.num_contacts = find(
            tables, world, b, trunk.pos, poses, contacts, branch.first_contact, wp.static(cylinders)
        )
        for j in range(wp.static(depth)):
            if j < joints:
                branch.acc[j] = worlds.qacc_warmstart[world, dof(tables.branch_joint[b, j])]
        if wp.static(meets_itself):
            self_rows.keep_poses(selves, world, b, poses)
            self_rows.keep_joints(tables, selves, world, b, joints, branch.acc)
        return branch

    @wp.func
    def make_all(
        tables: Tables,
        worlds: Worlds,
        world: int,
        lane: int,
        trunk: Trunk,
        acc: TrunkMotion,
        contacts: AnyContacts,
        kept: Kept,
        selves: Selves,
    ):
        """Build the branches; return (the last of) them and the sum of their inertias and wrenches."""
        branch = Branch()
        total = Body()
        for i in range(wp.static(per_lane)):
            b = lane + i * wp.static(lanes)
            if place.has(lane, i):
                branch = make_branch(tables, worlds, world, b, trunk, contacts, selves)
                branch = solver.start(branch, trunk.rot, acc, contacts)
                total = add_bodies(total, branch.smooth.total)
            place.keep(kept, world, i, branch)
        return branch, total

    @wp.func
    def meet_all(tables: Tables, world: int, lane: int, branch: Branch, kept: Kept, selves: Selves) -> Selves:
        """Return the contacts between parts of the robot, with the residuals of the accelerations to start from."""
        if wp.static(meets_itself):
            sync_group(wp.static(lanes))
            selves = find_self_contacts(tables, selves, world, lane)
            sync_group(wp.static(lanes))
            for i in range(wp.static(per_lane)):
                branch = place.take(kept, world, i, branch)
                if place.has(lane, i):
                    b = lane + i * wp.static(lanes)
                    self_rows.keep_columns(tables, selves, world, b, num_joints(tables, b), branch)
            sync_group(wp.static(lanes))
            self_rows.start_rows(selves, world, lane, wp.static(lanes))
            sync_group(wp.static(lanes))
        return selves

    @wp.func
    def damp_all(timestep: float, world: int, lane: int, branch: Branch, kept: Kept):
        """Assemble the equations of implicit damping; return also what is left for the trunk."""
        system = TrunkSystem()
        for i in range(wp.static(per_lane)):
            branch = place.take(kept, world, i, branch)
            if place.has(lane, i):
                branch = solver.assemble_damping(branch, timestep)
                system = solver.eliminate(branch, system, TrunkSystem())
            place.keep(kept, world, i, branch)
        return branch, system

    @wp.func
    def integrate_all(
        tables: Tables,
        worlds: Worlds,
        world: int,
        lane: int,
        branch: Branch,
        kept: Kept,
        damped: TrunkMotion,
        contacts: AnyContacts,
        selves: Selves,
        sense: bool,
    ):
        """Write the branches' state after the step, and their contact sensors."""
        for i in range(wp.static(per_lane)):
            b = lane + i * wp.static(lanes)
            branch = place.take(kept, world, i, branch)
            if place.has(lane, i):
                integrate_branch(tables, worlds, world, b, num_joints(tables, b), branch, damped)
                if sense:
                    sense_branch(tables, worlds, world, b, branch, contacts)
        if wp.static(meets_itself):
            sync_group(wp.static(lanes))
            if sense and lane == 0:
                sense_self_contacts(tables, worlds, world, selves)

    parts = (drive_all, make_all, meet_all, damp_all, integrate_all)
    return SimpleNamespace(**{part.func.__name__: part for part in parts})


@functools.cache
def in_solver(layout: Layout) -> SimpleNamespace:
    """Return the parts of a solver iteration.

    These are ``assemble_all``, ``couple_all``, ``turn_all``, ``line_search`` and ``move_all``.
    """
    lanes, per_lane, place = layout.lanes, layout.per_lane, places(layout)
    Branch = branch_types(layout.depth).Branch
    Kept, Selves, meets_itself = wp.array(dtype=Branch), layout.selves_type, bool(layout.self_kinds)
    num_joints, solve_system = joint_counter(layout), self_rows.system_solver(lanes)

    @wp.func
    def assemble_all(
        tables: Tables,
        world: int,
        lane: int,
        branch: Branch,
        kept: Kept,
        rot: wp.mat33,
        acc: TrunkMotion,
        contacts: AnyContacts,
        selves: Selves,
    ):
        """Assemble and eliminate the branches' Newton equations.

        Return also what is left for the trunk, and what they add to the trunk's equations before the elimination.
        """
        system, whole = TrunkSystem(), TrunkSystem()
        for i in range(wp.static(per_lane)):
            b = lane + i * wp.static(lanes)
            branch = place.take(kept, world, i, branch)
            if place.has(lane, i):
                branch, add = solver.assemble(branch, rot, acc, contacts)
                if wp.static(meets_itself):
                    joints = num_joints(tables, b)
                    branch = self_rows.push_branch(tables, selves, world, b, joints, branch)
                    if selves.coupled:
                        self_rows.keep_equations(tables, selves, world, b, joints, branch)
                        whole = solver.add_whole(branch, whole, add)
                branch.factor = cholesky(branch.factor)
                system = solver.eliminate(branch, system, add)
            place.keep(kept, world, i, branch)
        return branch, system, whole

    @wp.func
    def couple_all(
        world: int,
        lane: int,
        whole: WholeBody,
        residual: TrunkMotion,
        added: TrunkSystem,
        step: TrunkMotion,
        selves: Selves,
    ) -> TrunkMotion:
        """Return the trunk's step, another one if branches are coupled; then keep theirs, too. ``added`` is theirs."""
        if wp.static(meets_itself):  # noqa: SIM102 - this decides what is compiled
            if selves.coupled:
                lin = group_sum3(added.rhs_lin, wp.static(lanes)) - residual.lin
                ang = group_sum3(added.rhs_ang, wp.static(lanes)) - residual.ang
                matrix = trunk_matrix(whole, added, wp.static(lanes))
                if lane == 0:
                    self_rows.keep_trunk_equations(selves, world, matrix, lin, ang)
                step = solve_system(selves, world, lane)
        return step

    @wp.func
    def turn_all(
        tables: Tables,
        world: int,
        lane: int,
        branch: Branch,
        kept: Kept,
        rot: wp.mat33,
        step: TrunkMotion,
        contacts: AnyContacts,
        selves: Selves,
    ):
        """Find the branches' parts of the step; return also their slopes of the cost along it."""
        slopes = wp.vec3(0.0)
        for i in range(wp.static(per_lane)):
            b = lane + i * wp.static(lanes)
            branch = place.take(kept, world, i, branch)
            if place.has(lane, i):
                branch.step = solver.branch_step(branch, step)
                if wp.static(meets_itself):
                    joints = num_joints(tables, b)
                    if selves.coupled:
                        branch.step = self_rows.coupled_step(tables, selves, world, b, joints, branch.step)
                    self_rows.keep_joints(tables, selves, world, b, joints, branch.step)
                branch, of_rows = solver.turn_to(branch, rot, step, contacts)
                slopes += solver.slopes_at_start(branch, step, of_rows)
            place.keep(kept, world, i, branch)
        if wp.static(meets_itself):
            sync_group(wp.static(lanes))
            slopes[1] -= self_rows.turn_rows(selves, world, lane, wp.static(lanes))
        return branch, group_sum3(slopes, wp.static(lanes))

    @wp.func
    def line_search(
        tolerance: float,
        iterations: int,
        world: int,
        lane: int,
        branch: Branch,
        kept: Kept,
        at_start: wp.vec3,
        contacts: AnyContacts,
        selves: Selves,
    ) -> float:
        """Return the share of the step at which the cost is least: Newton's method, kept between bounds."""
        alpha = float(1.0)
        low = float(0.0)
        high = float(0.0)
        for _search in range(iterations):
            slopes = wp.vec2(0.0, 0.0)
            for i in range(wp.static(per_lane)):
                branch = place.take(kept, world, i, branch)
                slopes += solver.row_slopes(branch, contacts, alpha)
            if wp.static(meets_itself):
                for k in range(selves.first + lane, selves.end, wp.static(lanes)):
                    slopes = solver.add_contact_slopes(slopes, selves, k, alpha)
            slope = at_start[1] + alpha * at_start[2] + group_sum(slopes[0], wp.static(lanes))
            curvature = at_start[2] + group_sum(slopes[1], wp.static(lanes))
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
    def move_all(
        world: int, lane: int, branch: Branch, kept: Kept, contacts: AnyContacts, selves: Selves, alpha: float
    ):
        """Move the branches along the step; return also how many rows of the world changed their state."""
        flips = float(0.0)
        for i in range(wp.static(per_lane)):
            branch = place.take(kept, world, i, branch)
            branch, changed = solver.move(branch, contacts, alpha)
            flips += changed
            place.keep(kept, world, i, branch)
        if wp.static(meets_itself):
            for k in range(selves.first + lane, selves.end, wp.static(lanes)):
                flips += solver.move_contact(selves, k, alpha)
            sync_group(wp.static(lanes))
        return branch, group_sum(flips, wp.static(lanes))

    parts = (assemble_all, couple_all, turn_all, line_search, move_all)
    return SimpleNamespace(**{part.func.__name__: part for part in parts})
