"""The parts of a step over all branches of a thread: its one branch on a GPU, a world's all on a CPU.

On a GPU the branch stays in registers: it is handed from function to function as ``branch``. On a CPU the array
``kept`` holds the branches of the worlds while others have their turn, see :func:`places`.
"""

import functools
from types import SimpleNamespace
from typing import Any, NamedTuple

import warp as wp

from legged_torque.sim.fused import solver
from legged_torque.sim.fused.applied import apply_to_branch
from legged_torque.sim.fused.constraint import make_joint_rows
from legged_torque.sim.fused.contact import find_contacts
from legged_torque.sim.fused.integrate import integrate_branch, sense_branch
from legged_torque.sim.fused.map_contact import MAX_TOUCHES, find_map_contacts
from legged_torque.sim.fused.math import group_sum, group_sum3
from legged_torque.sim.fused.smooth import Pose, add_bodies, links_maker, make_equations
from legged_torque.sim.fused.tables import Tables, Worlds, dof, qadr
from legged_torque.sim.fused.tree import Tree
from legged_torque.sim.fused.trunk import TrunkMotion, TrunkSystem
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

    @classmethod
    def of(cls, tree: Tree, on_gpu: bool, on_map: bool = False) -> "Layout":
        """Return a robot's layout: on a GPU a thread per branch, rounded up to a power of two, else one per world."""
        branches, depth = tree.joints.shape
        points = tree.most_points * (MAX_TOUCHES if on_map else 1)
        lanes = 1 << (branches - 1).bit_length() if on_gpu else 1
        return cls(branches, depth, points, lanes, on_map, bool((tree.joints >= 0).all()), tree.has_cylinders)

    @property
    def per_lane(self) -> int:
        """Most branches of a thread."""
        return -(-self.branches // self.lanes)


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
    """Return what comes before and after the solver: ``drive_all``, ``make_all``, ``damp_all`` and ``integrate_all``.

    ``applied_forces`` says whether there are forces that a user applies, ``law`` what computes torques, if anything.
    """
    branches, depth, points, lanes, on_map, _, cylinders = layout
    per_lane, place, num_joints = layout.per_lane, places(layout), joint_counter(layout)
    find = find_map_contacts if on_map else find_contacts
    Branch, make_links = branch_types(depth).Branch, links_maker(depth)
    Kept = wp.array(dtype=Branch)

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
    def make_branch(tables: Tables, worlds: Worlds, world: int, b: int, trunk: Trunk, contacts: AnyContacts) -> Branch:
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
    ):
        """Build the branches; return (the last of) them and the sum of their inertias and wrenches."""
        branch = Branch()
        total = Body()
        for i in range(wp.static(per_lane)):
            b = lane + i * wp.static(lanes)
            if place.has(lane, i):
                branch = make_branch(tables, worlds, world, b, trunk, contacts)
                branch = solver.start(branch, trunk.rot, acc, contacts)
                total = add_bodies(total, branch.smooth.total)
            place.keep(kept, world, i, branch)
        return branch, total

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

    return SimpleNamespace(drive_all=drive_all, make_all=make_all, damp_all=damp_all, integrate_all=integrate_all)


@functools.cache
def in_solver(layout: Layout) -> SimpleNamespace:
    """Return the parts of a solver iteration: ``assemble_all``, ``turn_all``, ``line_search`` and ``move_all``."""
    lanes, per_lane, place = layout.lanes, layout.per_lane, places(layout)
    Branch = branch_types(layout.depth).Branch
    Kept = wp.array(dtype=Branch)

    @wp.func
    def assemble_all(
        world: int, lane: int, branch: Branch, kept: Kept, rot: wp.mat33, acc: TrunkMotion, contacts: AnyContacts
    ):
        """Assemble and eliminate the branches' Newton equations; return also what is left for the trunk."""
        system = TrunkSystem()
        for i in range(wp.static(per_lane)):
            branch = place.take(kept, world, i, branch)
            if place.has(lane, i):
                branch, add = solver.assemble(branch, rot, acc, contacts)
                system = solver.eliminate(branch, system, add)
            place.keep(kept, world, i, branch)
        return branch, system

    @wp.func
    def turn_all(
        world: int, lane: int, branch: Branch, kept: Kept, rot: wp.mat33, step: TrunkMotion, contacts: AnyContacts
    ):
        """Find the branches' parts of the step; return also their slopes of the cost along it."""
        slopes = wp.vec3(0.0)
        for i in range(wp.static(per_lane)):
            branch = place.take(kept, world, i, branch)
            if place.has(lane, i):
                branch, of_rows = solver.turn_to(branch, rot, step, contacts)
                slopes += solver.slopes_at_start(branch, step, of_rows)
            place.keep(kept, world, i, branch)
        return branch, group_sum3(slopes, wp.static(lanes))

    @wp.func
    def line_search(
        tolerance: float,
        iterations: int,
        world: int,
        branch: Branch,
        kept: Kept,
        at_start: wp.vec3,
        contacts: AnyContacts,
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
    def move_all(world: int, branch: Branch, kept: Kept, contacts: AnyContacts, alpha: float):
        """Move the branches along the step; return also how many rows of the world changed their state."""
        flips = float(0.0)
        for i in range(wp.static(per_lane)):
            branch = place.take(kept, world, i, branch)
            branch, changed = solver.move(branch, contacts, alpha)
            flips += changed
            place.keep(kept, world, i, branch)
        return branch, group_sum(flips, wp.static(lanes))

    return SimpleNamespace(assemble_all=assemble_all, turn_all=turn_all, line_search=line_search, move_all=move_all)
