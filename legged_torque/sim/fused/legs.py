"""The parts of a solver iteration over all branches of a thread: its one branch on a GPU, a world's all on a CPU.

On a GPU the branch stays in registers: it is handed from function to function as ``leg``. On a CPU the array ``legs``
keeps the branches of the world while others have their turn: the statements under ``several``.
"""

import functools
from types import SimpleNamespace

import warp as wp

from legged_torque.sim.fused.constraints import Contact
from legged_torque.sim.fused.dynamics import Body, Trunk, add_bodies
from legged_torque.sim.fused.math import group_sum, group_sum3, vec4
from legged_torque.sim.fused.newton import branch_newton
from legged_torque.sim.fused.robot import Robot
from legged_torque.sim.fused.stages import branch_stages
from legged_torque.sim.fused.trunk import TrunkMotion, TrunkSystem, WholeBody, trunk_slopes

LINE_SEARCH_TOLERANCE = wp.constant(0.01)
"""The line search stops when the slope has come down to this share of that at its start."""


@functools.cache
def all_legs(branches: int, depth: int, points: int, lanes: int) -> SimpleNamespace:
    """Return the functions for a robot's structure; for the arguments see :func:`~.step.make_kernel`."""
    per_lane = -(-branches // lanes)
    several = per_lane > 1
    newton, stages = branch_newton(depth), branch_stages(depth)
    Leg, start_leg, assemble, eliminate = newton.Leg, newton.start_leg, newton.assemble, newton.eliminate
    turn_to, slopes_at_start, row_slopes, move = newton.turn_to, newton.slopes_at_start, newton.row_slopes, newton.move
    assemble_damping = newton.assemble_damping
    make_leg, integrate_leg, sense_leg = stages.make_leg, stages.integrate_leg, stages.sense_leg

    @wp.func
    def make_all(
        robot: Robot, world: int, lane: int, legs: wp.array(dtype=Leg), trunk: Trunk, acc: TrunkMotion, normal: wp.vec3,
        ctrl: wp.array2d(dtype=float), qpos: wp.array2d(dtype=float), qvel: wp.array2d(dtype=float),
        warmstart: wp.array2d(dtype=float), contacts: wp.array(dtype=Contact), x: wp.array(dtype=vec4),
    ):  # fmt: skip
        """Build the branches; return (the last of) them and the sum of their inertias and wrenches."""
        leg = Leg()
        total = Body()
        for i in range(wp.static(per_lane)):
            branch = lane + i * wp.static(lanes)
            if branch < wp.static(branches):
                first = (world * wp.static(branches) + branch) * wp.static(points)
                leg = make_leg(robot, world, branch, trunk, normal, ctrl, qpos, qvel, warmstart, contacts, first)
                leg = start_leg(leg, trunk.rot, acc, normal, contacts, x)
                total = add_bodies(total, leg.branch.total)
            if wp.static(several):
                legs[world * wp.static(per_lane) + i] = leg
        return leg, total

    @wp.func
    def assemble_all(
        world: int, lane: int, leg: Leg, legs: wp.array(dtype=Leg), rot: wp.mat33, acc: TrunkMotion, normal: wp.vec3,
        contacts: wp.array(dtype=Contact), x: wp.array(dtype=vec4),
    ):  # fmt: skip
        """Assemble and eliminate the branches' Newton equations; return also what is left for the trunk."""
        system = TrunkSystem()
        for i in range(wp.static(per_lane)):
            if wp.static(several):
                leg = legs[world * wp.static(per_lane) + i]
            if lane + i * wp.static(lanes) < wp.static(branches):
                leg, add = assemble(leg, rot, acc, normal, contacts, x)
                system = eliminate(leg, system, add)
            if wp.static(several):
                legs[world * wp.static(per_lane) + i] = leg
        return leg, system

    @wp.func
    def turn_all(
        world: int, lane: int, leg: Leg, legs: wp.array(dtype=Leg), rot: wp.mat33, whole: WholeBody,
        residual: TrunkMotion, step: TrunkMotion, normal: wp.vec3, contacts: wp.array(dtype=Contact),
        x: wp.array(dtype=vec4), dx: wp.array(dtype=vec4),
    ):  # fmt: skip
        """Find the branches' parts of the step; return also the slopes of the cost along it, see trunk_slopes."""
        start = wp.vec3(0.0)
        for i in range(wp.static(per_lane)):
            if wp.static(several):
                leg = legs[world * wp.static(per_lane) + i]
            if lane + i * wp.static(lanes) < wp.static(branches):
                leg = turn_to(leg, rot, step, normal, contacts, dx)
                start += slopes_at_start(leg, step, contacts, x, dx)
            if wp.static(several):
                legs[world * wp.static(per_lane) + i] = leg
        return leg, group_sum3(start, wp.static(lanes)) + trunk_slopes(whole, residual, step)

    @wp.func
    def line_search(
        iterations: int, world: int, leg: Leg, legs: wp.array(dtype=Leg), start: wp.vec3,
        contacts: wp.array(dtype=Contact), x: wp.array(dtype=vec4), dx: wp.array(dtype=vec4),
    ) -> float:  # fmt: skip
        """Return the share of the step at which the cost is least: Newton's method, kept between bounds."""
        alpha = float(1.0)
        low = float(0.0)
        high = float(0.0)
        for _search in range(iterations):
            slopes = wp.vec2(0.0, 0.0)
            for i in range(wp.static(per_lane)):
                if wp.static(several):
                    leg = legs[world * wp.static(per_lane) + i]
                slopes += row_slopes(leg, contacts, x, dx, alpha)
            slope = start[1] + alpha * start[2] + group_sum(slopes[0], wp.static(lanes))
            curvature = start[2] + group_sum(slopes[1], wp.static(lanes))
            if wp.abs(slope) <= -LINE_SEARCH_TOLERANCE * start[0]:
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
        world: int, leg: Leg, legs: wp.array(dtype=Leg), x: wp.array(dtype=vec4), dx: wp.array(dtype=vec4), alpha: float
    ):
        """Move the branches along the step; return also how many rows of the world changed their state."""
        flips = float(0.0)
        for i in range(wp.static(per_lane)):
            if wp.static(several):
                leg = legs[world * wp.static(per_lane) + i]
            leg, changed = move(leg, x, dx, alpha)
            flips += changed
            if wp.static(several):
                legs[world * wp.static(per_lane) + i] = leg
        return leg, group_sum(flips, wp.static(lanes))

    @wp.func
    def damp_all(robot: Robot, world: int, lane: int, leg: Leg, legs: wp.array(dtype=Leg)):
        """Assemble the equations of implicit damping instead; return also what is left for the trunk."""
        system = TrunkSystem()
        for i in range(wp.static(per_lane)):
            if wp.static(several):
                leg = legs[world * wp.static(per_lane) + i]
            if lane + i * wp.static(lanes) < wp.static(branches):
                leg = assemble_damping(leg, robot.timestep)
                system = eliminate(leg, system, TrunkSystem())
            if wp.static(several):
                legs[world * wp.static(per_lane) + i] = leg
        return leg, system

    @wp.func
    def integrate_all(
        robot: Robot, world: int, lane: int, leg: Leg, legs: wp.array(dtype=Leg), damped: TrunkMotion, normal: wp.vec3,
        sense: bool, contacts: wp.array(dtype=Contact), x: wp.array(dtype=vec4), qpos: wp.array2d(dtype=float),
        qvel: wp.array2d(dtype=float), warmstart: wp.array2d(dtype=float), sensordata: wp.array2d(dtype=float),
    ):  # fmt: skip
        """Write the branches' state after the step, and their contact sensors."""
        for i in range(wp.static(per_lane)):
            branch = lane + i * wp.static(lanes)
            if wp.static(several):
                leg = legs[world * wp.static(per_lane) + i]
            if branch < wp.static(branches):
                integrate_leg(robot, world, branch, leg, damped, qpos, qvel, warmstart)
                if sense:
                    sense_leg(robot, world, branch, leg, normal, contacts, x, sensordata)

    return SimpleNamespace(
        Leg=Leg, make_all=make_all, assemble_all=assemble_all, turn_all=turn_all, line_search=line_search,
        move_all=move_all, damp_all=damp_all, integrate_all=integrate_all,
    )  # fmt: skip
