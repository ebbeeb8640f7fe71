"""What MuJoCo's ``mj_setConst`` derives from masses: inverse weights, recomputed in the worlds whose masses changed."""

import functools

import mujoco
import mujoco_warp as mjw
import warp as wp

from legged_torque.sim.fused.dynamics import Body, Trunk, add_bodies, branch_dynamics, make_trunk
from legged_torque.sim.fused.math import linear_algebra, row, vec6
from legged_torque.sim.fused.newton import branch_newton
from legged_torque.sim.fused.robot import Robot, lanes_per_world, make_robot, read_tree
from legged_torque.sim.fused.trunk import TrunkSystem, mat66, trunk_matrix, whole_body
from legged_torque.sim.per_world import expand


class DerivedConstants:
    """Keeps ``body_invweight0`` and ``dof_invweight0`` of every world in step with its other parameters.

    They scale the softness of contacts, limits and dry friction, and follow from masses, inertias and armatures in the
    model's reference pose.
    """

    def __init__(self, mj_model: mujoco.MjModel, model: mjw.Model, num_envs: int) -> None:
        """Prepare; gives every world its own row of both fields.

        Args:
            mj_model: The model.
            model: The same on the device.
            num_envs: Number of worlds.

        Raises:
            UserError: If the robot's structure is not a trunk with branches.
        """
        tree = read_tree(mj_model)
        self._num_envs, self._device = num_envs, model.qpos0.device
        for name in ("body_invweight0", "dof_invweight0"):
            expand(model, name, num_envs)
        branches, depth = tree.joints.shape
        lanes = lanes_per_world(branches, self._device.is_cuda)
        parts = depth + 1 if self._device.is_cuda else 1
        self._threads = lanes * parts
        self._kernel = make_kernel(branches, depth, lanes, parts)
        with wp.ScopedDevice(self._device):
            self._robot = make_robot(mj_model, model, tree)
            self._reference = wp.array(model.qpos0.numpy().repeat(num_envs, axis=0), dtype=wp.float32)
            self._rest = wp.zeros((num_envs, model.nv), dtype=wp.float32)

    def update(self, mask: wp.array) -> None:
        """Recompute the constants.

        Args:
            mask: Which worlds. Shape: (num_envs,), bool.
        """
        wp.launch(
            self._kernel,
            dim=(self._num_envs, self._threads),
            inputs=[self._robot, mask, self._reference, self._rest],
            outputs=[self._robot.body_invweight0, self._robot.dof_invweight0],
            device=self._device,
        )


@wp.func
def forward_solve(lower: mat66, b: vec6) -> vec6:
    """Return L^-1 b, where L has the inverse of its diagonal in the diagonal's place."""
    x = vec6()
    for i in range(6):
        rest = b[i]
        for k in range(6):
            if k < i:
                rest -= lower[i, k] * x[k]
        x[i] = rest * lower[i, i]
    return x


@functools.cache
def make_kernel(branches: int, depth: int, lanes: int, parts: int) -> wp.Kernel:
    """Return the kernel for a robot's structure.

    A step rarely changes more than a few worlds, so that the time of one counts, not their number: on a GPU each world
    has a group of threads per depth and one for the trunk, which all factorize its equations and then divide the rows.

    With the inertia matrix as an arrow, J M^-1 J^T of a body on a branch is that of the branch alone, with its trunk
    held, plus what the trunk's motion adds, seen through the branch: u^T S^-1 u, S being the trunk's six equations.

    Args:
        branches: Number of branches.
        depth: Joints per branch.
        lanes: Threads per group, a power of two; 1 on a CPU.
        parts: Groups per world: depth + 1, or 1, which does everything.
    """
    per_lane = -(-branches // lanes)
    dynamics, algebra = branch_dynamics(depth), linear_algebra(depth)
    vector, matrix, column = dynamics.vector, dynamics.matrix, dynamics.column
    Branch, make_branch = dynamics.Branch, dynamics.make_branch
    cholesky_solve = algebra.cholesky_solve
    Leg, assemble_damping, eliminate = (
        branch_newton(depth).Leg, branch_newton(depth).assemble_damping, branch_newton(depth).eliminate,
    )  # fmt: skip

    @wp.func
    def leg_at_rest(
        robot: Robot, world: int, branch: int, trunk: Trunk, qpos: wp.array2d(dtype=float),
        rest: wp.array2d(dtype=float), positions: wp.array(dtype=wp.vec3), rotations: wp.array(dtype=wp.mat33),
    ) -> Leg:  # fmt: skip
        """Return a branch with its inertia matrix factorized; fill the poses of its bodies."""
        velocities = wp.zeros(shape=wp.static(depth + 1), dtype=wp.vec3)
        leg = Leg()
        leg.branch = make_branch(
            robot, world, branch, trunk, qpos, rest, rest, positions, rotations, velocities, velocities
        )
        return assemble_damping(leg, 0.0)

    @wp.func
    def inverse_weight(
        branch: Branch, factor: matrix, trunk_factor: mat66, jac_lin: wp.vec3, jac_ang: wp.vec3, jac: vector
    ) -> float:
        """Return j M^-1 j^T of one row j = (trunk's translation, trunk's rotation, branch)."""
        solved = cholesky_solve(factor, jac)
        lin = jac_lin - branch.mass_lin * solved
        ang = jac_ang - branch.mass_ang * solved
        u = forward_solve(trunk_factor, vec6(lin[0], lin[1], lin[2], ang[0], ang[1], ang[2]))
        return wp.dot(jac, solved) + wp.dot(u, u)

    @wp.func
    def body_inverse_weights(
        branch: Branch, factor: matrix, trunk_factor: mat66, rot: wp.mat33, com: wp.vec3, body_depth: int
    ) -> wp.vec2:
        """Return the mean inverse weights of a body's centre of mass against translation, and of its rotation."""
        lever = -wp.skew(com) * rot
        translation = float(0.0)
        rotation = float(0.0)
        for r in range(3):
            jac = vector()
            turn = vector()
            for j in range(wp.static(depth)):
                if j < body_depth:
                    motion = column(branch.lever, j) + wp.cross(column(branch.axis, j), com)
                    jac[j] = motion[r]
                    turn[j] = branch.axis[r, j]
            unit = wp.vec3()
            unit[r] = 1.0
            row_ang = wp.vec3(lever[r, 0], lever[r, 1], lever[r, 2])
            row_rot = wp.vec3(rot[r, 0], rot[r, 1], rot[r, 2])
            translation += inverse_weight(branch, factor, trunk_factor, unit, row_ang, jac) / 3.0
            rotation += inverse_weight(branch, factor, trunk_factor, wp.vec3(0.0), row_rot, turn) / 3.0
        return wp.vec2(translation, rotation)

    @wp.func
    def trunk_constants(
        robot: Robot, world: int, rot: wp.mat33, trunk_factor: mat66, body_invweight0: wp.array2d(dtype=wp.vec2),
        dof_invweight0: wp.array2d(dtype=float),
    ):  # fmt: skip
        """Write the inverse weights of the trunk: means over its translations and over its rotations."""
        mean_lin = float(0.0)
        mean_ang = float(0.0)
        for r in range(6):
            unit = vec6()
            unit[r] = 1.0
            u = forward_solve(trunk_factor, unit)
            mean_lin += wp.where(r < 3, wp.dot(u, u) / 3.0, 0.0)
            mean_ang += wp.where(r < 3, 0.0, wp.dot(u, u) / 3.0)
        for r in range(3):
            dof_invweight0[world, r] = mean_lin
            dof_invweight0[world, r + 3] = mean_ang
        com = rot * robot.body_ipos[row(world, robot.body_ipos.shape[0]), 1]
        body_invweight0[world, 1] = body_inverse_weights(Branch(), matrix(), trunk_factor, rot, com, 0)

    @wp.func
    def branch_constants(
        robot: Robot, world: int, branch: int, part: int, leg: Leg, rot: wp.mat33, trunk_factor: mat66,
        positions: wp.array(dtype=wp.vec3), rotations: wp.array(dtype=wp.mat33),
        body_invweight0: wp.array2d(dtype=wp.vec2), dof_invweight0: wp.array2d(dtype=float),
    ):  # fmt: skip
        """Write the inverse weights of a branch's joints and bodies, or of those at the depth of this part."""
        for j in range(wp.static(depth)):
            if wp.static(parts == 1) or part == j:
                joint = robot.branch_joint[branch, j]
                unit = vector()
                unit[j] = 1.0
                dof_invweight0[world, joint + 5] = inverse_weight(
                    leg.branch, leg.factor, trunk_factor, wp.vec3(0.0), wp.vec3(0.0), unit
                )
                ipos = robot.body_ipos[row(world, robot.body_ipos.shape[0]), joint + 1]
                com = positions[j + 1] + rotations[j + 1] * ipos
                body_invweight0[world, joint + 1] = body_inverse_weights(
                    leg.branch, leg.factor, trunk_factor, rot, com, j + 1
                )

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def derive_constants(
        robot: Robot, mask: wp.array(dtype=wp.bool), qpos: wp.array2d(dtype=float), rest: wp.array2d(dtype=float),
        body_invweight0: wp.array2d(dtype=wp.vec2), dof_invweight0: wp.array2d(dtype=float),
    ):  # fmt: skip
        world, thread = wp.tid()
        lane = thread % wp.static(lanes)
        part = thread // wp.static(lanes)
        if mask[world]:
            positions = wp.zeros(shape=wp.static(depth + 1), dtype=wp.vec3)
            rotations = wp.zeros(shape=wp.static(depth + 1), dtype=wp.mat33)
            trunk = make_trunk(robot, world, qpos, rest)
            total = Body()
            system = TrunkSystem()
            leg = Leg()
            for i in range(wp.static(per_lane)):
                branch = lane + i * wp.static(lanes)
                if branch < wp.static(branches):
                    leg = leg_at_rest(robot, world, branch, trunk, qpos, rest, positions, rotations)
                    system = eliminate(leg, system, TrunkSystem())
                    total = add_bodies(total, leg.branch.total)
            whole = whole_body(trunk, total, wp.static(lanes))
            trunk_factor = wp.static(linear_algebra(6).cholesky)(trunk_matrix(whole, system, wp.static(lanes)))
            if thread == wp.static((parts - 1) * lanes):
                trunk_constants(robot, world, trunk.rot, trunk_factor, body_invweight0, dof_invweight0)
            for i in range(wp.static(per_lane)):
                branch = lane + i * wp.static(lanes)
                if branch < wp.static(branches):
                    if wp.static(per_lane > 1):  # a CPU's thread has several branches, of which it kept the last one
                        leg = leg_at_rest(robot, world, branch, trunk, qpos, rest, positions, rotations)
                    branch_constants(
                        robot, world, branch, part, leg, trunk.rot, trunk_factor, positions, rotations,
                        body_invweight0, dof_invweight0,
                    )  # fmt: skip

    return derive_constants
