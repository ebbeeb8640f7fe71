"""The stages of a step before and after the solver, over the branches of a thread."""

import functools
from typing import Any

import warp as wp

from legged_torque.sim.fused import constraint_self, solver
from legged_torque.sim.fused.applied import apply_to_branch
from legged_torque.sim.fused.collision import find_contacts
from legged_torque.sim.fused.collision_map import find_map_contacts
from legged_torque.sim.fused.collision_self import self_contact_finder
from legged_torque.sim.fused.constraint import make_joint_rows
from legged_torque.sim.fused.integrate import integrate_branch, sense_branch, sense_self_contacts
from legged_torque.sim.fused.layout import Layout, branches_of
from legged_torque.sim.fused.math import sync_group
from legged_torque.sim.fused.model import Model, State, dof, qadr
from legged_torque.sim.fused.smooth import Pose, add_bodies, links_maker, make_equations
from legged_torque.sim.fused.trunk import TrunkMotion, TrunkSystem
from legged_torque.sim.fused.types import AnyBranch, Body, Trunk, branch_types


@functools.cache
def torque_writer(layout: Layout, law: wp.Function | None) -> wp.Function:
    """Return ``write_torques`` for a control law; without one, torques are in ``ctrl`` already."""
    depth, own = layout.depth, branches_of(layout)

    @wp.func
    def write_torques(model: Model, state: State, world: int, thread: int, step: int, reads: Any):
        """Write the torques of the branches' motors in one step of this launch."""
        if wp.static(law is not None):
            for i in range(wp.static(own.per_thread)):
                b = thread + i * wp.static(own.threads)
                if own.owns(thread, i):
                    for j in range(wp.static(depth)):
                        joint = model.branch_joint[b, j]
                        motor = model.branch_actuator[b, j]
                        if motor >= 0:
                            pos = state.qpos[world, qadr(joint)]
                            vel = state.qvel[world, dof(joint)]
                            state.ctrl[world, motor] = law(reads, world, motor, step, pos, vel)

    return write_torques


@functools.cache
def branch_maker(layout: Layout, applied_forces: bool) -> wp.Function:
    """Return ``make_branch``, with or without forces that a user applies."""
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
            constraint_self.show_poses(scratch.selves, world, b, poses)
            constraint_self.show_joints(model, scratch.selves, world, b, joints, branch.acc)
        return branch

    return make_branch


@functools.cache
def branches_maker(layout: Layout, applied_forces: bool) -> wp.Function:
    """Return ``make_branches``, with or without forces that a user applies."""
    own, Branch, make_branch = (
        branches_of(layout),
        branch_types(layout.depth).Branch,
        branch_maker(layout, applied_forces),
    )

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
    def make_self_constraints(model: Model, scratch: own.Scratch, world: int, thread: int, branch: AnyBranch):
        """Find contacts between parts of the robot and their residuals at the start."""
        if wp.static(own.collide):
            sync_group(wp.static(own.threads))
            scratch.selves = find_self_contacts(model, scratch.selves, world, thread)
            sync_group(wp.static(own.threads))
            for i in range(wp.static(own.per_thread)):
                branch = own.load(scratch, world, i, branch)
                if own.owns(thread, i):
                    b = thread + i * wp.static(own.threads)
                    constraint_self.show_columns(model, scratch.selves, world, b, own.num_joints(model, b), branch)
            sync_group(wp.static(own.threads))
            constraint_self.start_rows(scratch.selves, world, thread, wp.static(own.threads))
            sync_group(wp.static(own.threads))
        return scratch

    return make_self_constraints


@functools.cache
def damping_assembler(layout: Layout) -> wp.Function:
    """Return ``assemble_damping``."""
    own = branches_of(layout)

    @wp.func
    def assemble_damping(model: Model, scratch: own.Scratch, world: int, thread: int, branch: AnyBranch):
        """Assemble the equations of implicit damping; return also what they leave for the trunk."""
        system = TrunkSystem()
        for i in range(wp.static(own.per_thread)):
            branch = own.load(scratch, world, i, branch)
            if own.owns(thread, i):
                branch = solver.assemble_damping(branch, model.timestep)
                system = solver.eliminate(branch, system, TrunkSystem())
            own.store(scratch, world, i, branch)
        return branch, system

    return assemble_damping


@functools.cache
def integrator(layout: Layout) -> wp.Function:
    """Return ``integrate``."""
    own = branches_of(layout)

    @wp.func
    def integrate(
        model: Model,
        state: State,
        scratch: own.Scratch,
        world: int,
        thread: int,
        branch: AnyBranch,
        damped: TrunkMotion,
        sense: bool,
    ):
        """Write state and contact sensors of the branches after the step."""
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
                sense_self_contacts(model, state, world, scratch.selves)

    return integrate
