"""Physics steps as one kernel: a group of threads per world, one thread per branch.

MuJoCo Warp runs a step as some hundred small kernels, which wait for each other and for memory. A legged robot on
the ground is small: a trunk and a few branches of hinge joints that meet only there. Here a thread holds a branch in
registers from kinematics to integration, and the threads of a world sum up the terms of the trunk.
"""

import functools

import warp as wp

from legged_torque.sim.fused import constraint_self, solver
from legged_torque.sim.fused.collision import find_contacts, place_plane
from legged_torque.sim.fused.collision_map import find_map_contacts, place_map
from legged_torque.sim.fused.collision_self import Touching, self_contact_finder, write_parts
from legged_torque.sim.fused.constraint import make_joint_rows
from legged_torque.sim.fused.integrate import integrate_branch, integrate_trunk, sense_branch, sense_self_contacts
from legged_torque.sim.fused.layout import Layout, branches_of
from legged_torque.sim.fused.math import sync_group
from legged_torque.sim.fused.model import Model, State, dof, local_copy
from legged_torque.sim.fused.newton import newton_solver
from legged_torque.sim.fused.smooth import (
    Pose,
    add_bodies,
    apply_to_branch,
    apply_to_trunk,
    links_maker,
    make_equations,
    make_trunk,
)
from legged_torque.sim.fused.surface import Surface
from legged_torque.sim.fused.trunk import TrunkMotion, TrunkSystem, WholeBody, solve_trunk, warm_start, whole_body
from legged_torque.sim.fused.types import AnyBranch, Body, Trunk, branch_types


@functools.cache
def branches_maker(layout: Layout, applied_forces: bool) -> wp.Function:
    """Return ``make_branches``, with or without forces that a user applies."""
    branches, depth, points, _, on_map, _, cylinders, _ = layout
    own, make_links, Branch = branches_of(layout), links_maker(depth), branch_types(depth).Branch
    find = find_map_contacts if on_map else find_contacts

    @wp.func
    def make_branch(model: Model, state: State, scratch: own.Scratch, world: int, b: int, trunk: Trunk) -> Branch:
        """Return a branch with its equations of motion, constraints and the accelerations to start from."""
        poses = wp.zeros(shape=wp.static(depth + 1), dtype=Pose)
        joints = own.num_joints(model, b)
        branch, links = make_links(model, state, world, b, joints, trunk, poses)
        if wp.static(applied_forces):
            branch, links = apply_to_branch(branch, links, model, state, world, b, joints, poses)
        branch = make_equations(branch, links, model, world, b, joints, trunk.rot)
        branch.rows = make_joint_rows(branch.rows, model, state, world, b, joints)
        branch.first_contact = (world * wp.static(branches) + b) * wp.static(points)
        branch.num_contacts = find(
            model, world, b, trunk.pos, poses, scratch.contacts, branch.first_contact, wp.static(cylinders)
        )
        for j in range(wp.static(depth)):
            if j < joints:
                branch.acc[j] = state.qacc_warmstart[world, dof(model.branch_joint[b, j])]
        if wp.static(own.collide):
            write_parts(model, scratch.selves, world, b, poses)
        return branch

    @wp.func
    def make_branches(
        model: Model, state: State, scratch: own.Scratch, world: int, thread: int, trunk: Trunk, acc: TrunkMotion
    ):
        """Build the branches; return the last one, and the sum of their inertias and wrenches."""
        branch = Branch()
        total = Body()
        for i in range(wp.static(own.per_thread)):
            b = thread + i * wp.static(own.threads)
            if own.owns(thread, i):
                branch = make_branch(model, state, scratch, world, b, trunk)
                branch = solver.start(branch, trunk.rot, acc, scratch.contacts)
                total = add_bodies(total, branch.smooth.total)
            own.store(scratch, world, i, branch)
        return branch, total

    return make_branches


@functools.cache
def self_constraint_maker(layout: Layout) -> wp.Function:
    """Return ``make_self_constraints``."""
    own, find_self_contacts = branches_of(layout), self_contact_finder(layout.self_kinds, layout.threads)

    @wp.func
    def make_self_constraints(
        model: Model, state: State, scratch: own.Scratch, world: int, thread: int, branch: AnyBranch
    ):
        """Find contacts between parts of the robot and their residuals at the start."""
        touching = Touching()
        if wp.static(own.collide):
            sync_group(wp.static(own.threads))
            touching = find_self_contacts(model, scratch.selves, world, thread)
            sync_group(wp.static(own.threads))
            for i in range(wp.static(own.per_thread)):
                branch = own.load(scratch, world, i, branch)
                if own.owns(thread, i):
                    b = thread + i * wp.static(own.threads)
                    constraint_self.write_jacobians(
                        model, scratch.selves, touching, world, b, own.num_joints(model, b), branch
                    )
            sync_group(wp.static(own.threads))
            constraint_self.start_rows(model, state, scratch.selves, touching, world, thread, wp.static(own.threads))
            sync_group(wp.static(own.threads))
        return touching

    return make_self_constraints


@functools.cache
def integrator(layout: Layout) -> wp.Function:
    """Return ``integrate``."""
    own = branches_of(layout)

    @wp.func
    def integrate(
        model: Model,
        state: State,
        scratch: own.Scratch,
        touching: Touching,
        world: int,
        thread: int,
        branch: AnyBranch,
        whole: WholeBody,
        trunk: Trunk,
        acc: TrunkMotion,
        sense: bool,
    ):
        """Write the state after the step, with implicit damping, and the contact sensors."""
        system = TrunkSystem()
        for i in range(wp.static(own.per_thread)):
            branch = own.load(scratch, world, i, branch)
            if own.owns(thread, i):
                branch = solver.assemble_damping(branch, model.timestep)
                system = solver.eliminate(branch, system, TrunkSystem())
            own.store(scratch, world, i, branch)
        damped = solve_trunk(whole, TrunkMotion(), system, wp.static(own.threads))
        for i in range(wp.static(own.per_thread)):
            b = thread + i * wp.static(own.threads)
            branch = own.load(scratch, world, i, branch)
            if own.owns(thread, i):
                integrate_branch(model, state, world, b, own.num_joints(model, b), branch, damped)
                if sense:
                    sense_branch(model, state, world, b, branch, scratch.contacts)
        if wp.static(own.collide):
            sync_group(wp.static(own.threads))
            if sense and thread == 0:
                sense_self_contacts(model, state, world, scratch.selves, touching)
        if thread == 0:
            integrate_trunk(model.timestep, state, world, trunk, acc, damped)

    return integrate


@functools.cache
def make_kernel(layout: Layout, applied_forces: bool) -> wp.Kernel:
    """Return the kernel for a robot's structure, with or without forces that a user applies."""
    make_branches = branches_maker(layout, applied_forces)
    make_self_constraints = self_constraint_maker(layout)
    solve = newton_solver(layout)
    integrate = integrator(layout)
    own = branches_of(layout)
    Ground, place_ground = (Surface, place_map) if layout.on_map else (wp.int32, place_plane)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def fused_step(
        first_world: int,
        # Model:
        model: Model,
        ground: Ground,
        # Data, in and out:
        data: State,
        scratch: own.Scratch,
        sense: bool,
    ):
        place, thread = wp.tid()
        world = first_world + place
        state = local_copy(data)
        scratch.contacts = place_ground(model, ground, world, scratch.contacts)
        trunk = make_trunk(model, state, world)
        if wp.static(applied_forces):
            trunk = apply_to_trunk(model, state, world, trunk)
        acc = warm_start(state, world)
        branch, total = make_branches(model, state, scratch, world, thread, trunk, acc)
        touching = make_self_constraints(model, state, scratch, world, thread, branch)
        whole = whole_body(trunk, total, wp.static(own.threads))
        branch, acc, used = solve(model, scratch, touching, world, thread, whole, branch, trunk.rot, acc)
        integrate(model, state, scratch, touching, world, thread, branch, whole, trunk, acc, sense)
        if thread == 0:
            state.solver_niter[world] = used

    return fused_step
