"""Physics steps as one kernel: a group of threads per world, one thread per branch.

MuJoCo Warp runs a step as some hundred small kernels, which wait for each other and for memory. A legged robot on
the ground is small: a trunk and a few branches of hinge joints that meet only there. Here a thread holds a branch in
registers from kinematics to integration, and the threads of a world sum up the terms of the trunk.

A launch may do several steps, each under torques that a Warp function computes from the state of the joints.
"""

import functools

import warp as wp

from legged_torque.sim.fused import forward
from legged_torque.sim.fused.applied import apply_to_trunk
from legged_torque.sim.fused.collision import place_plane
from legged_torque.sim.fused.collision_map import place_map
from legged_torque.sim.fused.integrate import integrate_trunk
from legged_torque.sim.fused.layout import Layout, branches_of
from legged_torque.sim.fused.model import Model, State, local_copy
from legged_torque.sim.fused.newton import newton_solver
from legged_torque.sim.fused.smooth import make_trunk, trunk_pose
from legged_torque.sim.fused.surface import Surface
from legged_torque.sim.fused.trunk import TrunkMotion, solve_trunk, warm_start, whole_body


@functools.cache
def make_kernel(layout: Layout, applied_forces: bool, law: wp.Function | None = None) -> wp.Kernel:
    """Return the kernel for a robot's structure, with or without forces that a user applies, and a law for torques."""
    write_torques = forward.torque_writer(layout, law)
    make_branches = forward.branches_maker(layout, applied_forces)
    make_self_constraints = forward.self_constraint_maker(layout)
    solve = newton_solver(layout)
    assemble_damping = forward.damping_assembler(layout)
    integrate = forward.integrator(layout)
    own = branches_of(layout)
    Ground, place_ground = (Surface, place_map) if layout.on_map else (wp.int32, place_plane)
    Reads = next(iter(law.input_types.values())) if law else wp.int32  # the law's first argument

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def fused_step(
        first_world: int,
        # Model:
        model: Model,
        ground: Ground,
        reads: Reads,
        # Data, in and out:
        data: State,
        scratch: own.Scratch,
        # Steps of this launch:
        first_step: int,
        end_step: int,
        sense: bool,
    ):
        place, thread = wp.tid()
        world = first_world + place
        state = local_copy(data)
        scratch.contacts = place_ground(model, ground, world, scratch.contacts)
        for step in range(first_step, end_step):
            trunk = make_trunk(model, state, world)
            if wp.static(applied_forces):
                trunk = apply_to_trunk(model, state, world, trunk, trunk_pose(trunk))
            acc = warm_start(state, world)
            write_torques(model, state, world, thread, step, reads)
            branch, total = make_branches(model, state, scratch, world, thread, trunk, acc)
            scratch = make_self_constraints(model, scratch, world, thread, branch)
            whole = whole_body(trunk, total, wp.static(own.threads))
            branch, acc, used = solve(model, scratch, world, thread, whole, branch, trunk.rot, acc)
            branch, system = assemble_damping(model, scratch, world, thread, branch)
            damped = solve_trunk(whole, TrunkMotion(), system, wp.static(own.threads))
            integrate(model, state, scratch, world, thread, branch, damped, sense and step == end_step - 1)
            if thread == 0:
                integrate_trunk(model.timestep, state, world, trunk, acc, damped)
                state.solver_niter[world] = used

    return fused_step
