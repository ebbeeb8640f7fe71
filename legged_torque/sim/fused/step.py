"""One physics step as one kernel: a group of threads per world, one thread per leg.

MuJoCo Warp runs a step as some hundred small kernels, which wait for each other and for memory. A legged robot on a
plane is small: a trunk and a few branches of hinge joints that meet only there. Here a thread holds a branch in
registers from kinematics to integration, and the threads of a world add up what concerns the trunk.
"""

import functools

import mujoco
import mujoco_warp as mjw
import warp as wp

from legged_torque.sim.fused.constraints import Contact, floor_normal
from legged_torque.sim.fused.dynamics import Body, add_bodies, make_trunk
from legged_torque.sim.fused.math import group_sum, group_sum3, vec4
from legged_torque.sim.fused.newton import TrunkMotion, TrunkSystem, branch_newton
from legged_torque.sim.fused.robot import Robot, make_robot, read_tree
from legged_torque.sim.fused.stages import branch_stages, integrate_trunk
from legged_torque.sim.fused.trunk import add_systems, solve_trunk, trunk_residual, trunk_slopes, whole_body

BLOCK_DIM = 128
"""Threads per block: the fastest of 32, 64 and 128 from 4096 worlds on."""
TOLERANCE = wp.constant(1.0e-9)
"""The solver stops when a step promises less than this decrease of the cost, in MuJoCo's units."""
LINE_SEARCH_TOLERANCE = wp.constant(0.01)
"""The line search stops when the slope has come down to this share of that at its start."""


class FusedStep:
    """Steps all worlds of a MuJoCo Warp ``Data``, on its own arrays."""

    def __init__(self, mj_model: mujoco.MjModel, model: mjw.Model, data: mjw.Data) -> None:
        """Read the robot's structure and prepare the kernel; it compiles at the first step.

        Args:
            mj_model: The model.
            model: The same on the device; parameters that change there act at once.
            data: The worlds.

        Raises:
            UserError: If the robot has something that this step does not simulate.
        """
        tree = read_tree(mj_model)
        branches, depth = tree.joints.shape
        self._data = data
        self._device = data.qpos.device
        with wp.ScopedDevice(self._device):
            self._robot = make_robot(mj_model, model, tree)
        self._lanes = 1 << (branches - 1).bit_length() if self._device.is_cuda else 1
        points = max(1, *(len(points) for points in tree.points))
        room = data.nworld * branches * points
        self._scratch = [wp.empty(room, dtype=dtype, device=self._device) for dtype in (Contact, vec4, vec4)]
        self._kernel = make_kernel(branches, depth, points, self._lanes)
        self._limits = (mj_model.opt.iterations, mj_model.opt.ls_iterations)

    def __call__(self, sense: bool) -> None:
        """Advance every world by one physics step.

        Args:
            sense: Whether to write the contact sensors.
        """
        data = self._data
        wp.launch(
            self._kernel,
            dim=(data.nworld, self._lanes),
            inputs=[self._robot, *self._limits, sense, data.ctrl],
            outputs=[
                data.qpos, data.qvel, data.qacc_warmstart, data.sensordata, data.solver_niter, *self._scratch,
            ],  # fmt: skip
            block_dim=BLOCK_DIM,
            device=self._device,
        )


@functools.cache
def make_kernel(branches: int, depth: int, points: int, lanes: int) -> wp.Kernel:
    """Return the kernel for a robot's structure.

    On a GPU each thread keeps its one branch in registers. On a CPU the only thread of a world goes through all of
    them in turns, and an array keeps those that wait: the statements under ``several``.

    Args:
        branches: Number of branches.
        depth: Joints per branch.
        points: Most contacts of a branch with the floor.
        lanes: Threads per world, a power of two; 1 on a CPU.
    """
    per_lane = -(-branches // lanes)
    several = per_lane > 1
    newton, stages = branch_newton(depth), branch_stages(depth)
    Leg, start_leg, assemble, eliminate = newton.Leg, newton.start_leg, newton.assemble, newton.eliminate
    turn_to, assemble_damping, branch_step = newton.turn_to, newton.assemble_damping, newton.branch_step
    slopes_at_start, row_slopes, move = newton.slopes_at_start, newton.row_slopes, newton.move
    make_leg, integrate_leg, sense_leg = stages.make_leg, stages.integrate_leg, stages.sense_leg

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def fused_step(
        robot: Robot, iterations: int, ls_iterations: int, sense: bool, ctrl: wp.array2d(dtype=float),
        qpos: wp.array2d(dtype=float), qvel: wp.array2d(dtype=float), warmstart: wp.array2d(dtype=float),
        sensordata: wp.array2d(dtype=float), niter: wp.array(dtype=int), contacts: wp.array(dtype=Contact),
        x: wp.array(dtype=vec4), dx: wp.array(dtype=vec4),
    ):  # fmt: skip
        world, lane = wp.tid()
        leg = Leg()
        if wp.static(several):
            legs = wp.zeros(shape=wp.static(per_lane), dtype=Leg)
        trunk = make_trunk(robot, world, qpos, qvel)
        normal = floor_normal(robot, world)
        acc = TrunkMotion()
        acc.lin = wp.vec3(warmstart[world, 0], warmstart[world, 1], warmstart[world, 2])
        acc.ang = wp.vec3(warmstart[world, 3], warmstart[world, 4], warmstart[world, 5])
        total = Body()
        for i in range(wp.static(per_lane)):
            branch = lane + i * wp.static(lanes)
            if branch < wp.static(branches):
                leg = make_leg(
                    robot, world, branch, trunk, normal, ctrl, qpos, qvel, warmstart, contacts,
                    (world * wp.static(branches) + branch) * wp.static(points),
                )  # fmt: skip
                leg = start_leg(leg, trunk.rot, acc, normal, contacts, x)
                total = add_bodies(total, leg.branch.total)
            if wp.static(several):
                legs[i] = leg
        whole = whole_body(trunk, total, wp.static(lanes))

        used = int(0)
        for _iteration in range(iterations):
            used += 1
            system = TrunkSystem()
            for i in range(wp.static(per_lane)):
                if wp.static(several):
                    leg = legs[i]
                if lane + i * wp.static(lanes) < wp.static(branches):
                    leg, add = assemble(leg, trunk.rot, acc, normal, contacts, x)
                    system = add_systems(system, eliminate(leg, add))
                if wp.static(several):
                    legs[i] = leg
            residual = trunk_residual(whole, acc)
            step = solve_trunk(whole, residual, system, wp.static(lanes))
            start = wp.vec3(0.0)
            for i in range(wp.static(per_lane)):
                if wp.static(several):
                    leg = legs[i]
                if lane + i * wp.static(lanes) < wp.static(branches):
                    leg = turn_to(leg, trunk.rot, step, normal, contacts, dx)
                    start += slopes_at_start(leg, step, contacts, x, dx)
                if wp.static(several):
                    legs[i] = leg
            start = group_sum3(start, wp.static(lanes)) + trunk_slopes(whole, residual, step)
            if not (-start[0] * robot.cost_scale > TOLERANCE):
                break
            alpha = float(1.0)
            low = float(0.0)
            high = float(0.0)
            for _search in range(ls_iterations):
                slopes = wp.vec2(0.0, 0.0)
                for i in range(wp.static(per_lane)):
                    if wp.static(several):
                        leg = legs[i]
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
            flips = float(0.0)
            acc.lin = acc.lin + alpha * step.lin
            acc.ang = acc.ang + alpha * step.ang
            for i in range(wp.static(per_lane)):
                if wp.static(several):
                    leg = legs[i]
                leg, leg_flips = move(leg, x, dx, alpha)
                flips += leg_flips
                if wp.static(several):
                    legs[i] = leg
            if alpha == 1.0 and group_sum(flips, wp.static(lanes)) == 0.0:
                break  # the whole step stayed in one piece of the piecewise quadratic cost: this is its minimum

        system = TrunkSystem()
        for i in range(wp.static(per_lane)):
            if wp.static(several):
                leg = legs[i]
            if lane + i * wp.static(lanes) < wp.static(branches):
                leg = assemble_damping(leg, robot.timestep)
                system = add_systems(system, eliminate(leg, TrunkSystem()))
            if wp.static(several):
                legs[i] = leg
        step = solve_trunk(whole, TrunkMotion(), system, wp.static(lanes))
        for i in range(wp.static(per_lane)):
            branch = lane + i * wp.static(lanes)
            if wp.static(several):
                leg = legs[i]
            if branch < wp.static(branches):
                integrate_leg(robot, world, branch, leg, step, qpos, qvel, warmstart)
                if sense:
                    sense_leg(robot, world, branch, leg, normal, contacts, x, sensordata)
        if lane == 0:
            integrate_trunk(robot, world, trunk, acc, step, qpos, qvel, warmstart)
            niter[world] = used

    return fused_step
