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
from legged_torque.sim.fused.dynamics import make_trunk
from legged_torque.sim.fused.legs import all_legs
from legged_torque.sim.fused.math import vec4
from legged_torque.sim.fused.newton import branch_newton
from legged_torque.sim.fused.robot import Robot, lanes_per_world, make_robot, read_tree
from legged_torque.sim.fused.stages import integrate_trunk
from legged_torque.sim.fused.trunk import TrunkMotion, solve_trunk, trunk_residual, whole_body

BLOCK_DIM = 128
"""Threads per block: the fastest of 32, 64 and 128 from 4096 worlds on."""
TOLERANCE = wp.constant(1.0e-9)
"""The solver stops when a step promises less than this decrease of the cost, in MuJoCo's units."""


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
        self._lanes = lanes_per_world(branches, self._device.is_cuda)
        points = max(1, *(len(points) for points in tree.points))
        room = data.nworld * branches * points
        self._scratch = [wp.empty(room, dtype=dtype, device=self._device) for dtype in (Contact, vec4, vec4)]
        waiting = 1 if self._device.is_cuda else data.nworld * branches  # a GPU's threads have one branch each
        self._scratch.append(wp.empty(waiting, dtype=branch_newton(depth).Leg, device=self._device))
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
                data.qpos,
                data.qvel,
                data.qacc_warmstart,
                data.sensordata,
                data.solver_niter,
                *self._scratch,
            ],  # fmt: skip
            block_dim=BLOCK_DIM,
            device=self._device,
        )


@functools.cache
def make_kernel(branches: int, depth: int, points: int, lanes: int) -> wp.Kernel:
    """Return the kernel for a robot's structure.

    Args:
        branches: Number of branches.
        depth: Joints per branch.
        points: Most contacts of a branch with the floor.
        lanes: Threads per world, a power of two; 1 on a CPU.
    """
    parts = all_legs(branches, depth, points, lanes)
    Leg, make_all, assemble_all, turn_all = parts.Leg, parts.make_all, parts.assemble_all, parts.turn_all
    line_search, move_all, damp_all = parts.line_search, parts.move_all, parts.damp_all
    integrate_all = parts.integrate_all

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def fused_step(
        robot: Robot, iterations: int, ls_iterations: int, sense: bool, ctrl: wp.array2d(dtype=float),
        qpos: wp.array2d(dtype=float), qvel: wp.array2d(dtype=float), warmstart: wp.array2d(dtype=float),
        sensordata: wp.array2d(dtype=float), niter: wp.array(dtype=int), contacts: wp.array(dtype=Contact),
        x: wp.array(dtype=vec4), dx: wp.array(dtype=vec4), legs: wp.array(dtype=Leg),
    ):  # fmt: skip
        world, lane = wp.tid()
        trunk = make_trunk(robot, world, qpos, qvel)
        normal = floor_normal(robot, world)
        acc = TrunkMotion()
        acc.lin = wp.vec3(warmstart[world, 0], warmstart[world, 1], warmstart[world, 2])
        acc.ang = wp.vec3(warmstart[world, 3], warmstart[world, 4], warmstart[world, 5])
        leg, total = make_all(robot, world, lane, legs, trunk, acc, normal, ctrl, qpos, qvel, warmstart, contacts, x)
        whole = whole_body(trunk, total, wp.static(lanes))
        used = int(0)
        for _iteration in range(iterations):
            used += 1
            leg, system = assemble_all(world, lane, leg, legs, trunk.rot, acc, normal, contacts, x)
            residual = trunk_residual(whole, acc)
            step = solve_trunk(whole, residual, system, wp.static(lanes))
            leg, start = turn_all(world, lane, leg, legs, trunk.rot, whole, residual, step, normal, contacts, x, dx)
            if not (-start[0] * robot.cost_scale > TOLERANCE):
                break
            alpha = line_search(ls_iterations, world, leg, legs, start, contacts, x, dx)
            acc.lin = acc.lin + alpha * step.lin
            acc.ang = acc.ang + alpha * step.ang
            leg, flips = move_all(world, leg, legs, x, dx, alpha)
            if alpha == 1.0 and flips == 0.0:
                break  # the whole step stayed in one piece of the piecewise quadratic cost: this is its minimum
        leg, system = damp_all(robot, world, lane, leg, legs)
        damped = solve_trunk(whole, TrunkMotion(), system, wp.static(lanes))
        integrate_all(
            robot, world, lane, leg, legs, damped, normal, sense, contacts, x, qpos, qvel, warmstart, sensordata
        )
        if lane == 0:
            integrate_trunk(robot, world, trunk, acc, damped, qpos, qvel, warmstart)
            niter[world] = used

    return fused_step
