"""What MuJoCo's ``mj_setConst`` derives from masses: inverse weights, recomputed in the worlds whose masses changed."""

import functools

import mujoco
import mujoco_warp as mjw
import warp as wp

from legged_torque.sim.fused.dynamics import Body, add_bodies, branch_dynamics, make_trunk
from legged_torque.sim.fused.math import group_sum33, group_sum33_symmetric, linear_algebra, row, skew, vec6
from legged_torque.sim.fused.robot import Robot, lanes_per_world, make_robot, read_tree
from legged_torque.sim.fused.trunk import whole_body
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
        self._lanes = lanes_per_world(len(tree.joints), self._device.is_cuda)
        self._kernel = make_kernel(*tree.joints.shape, self._lanes)
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
            dim=(self._num_envs, self._lanes),
            inputs=[self._robot, mask, self._reference, self._rest],
            outputs=[self._robot.body_invweight0, self._robot.dof_invweight0],
            device=self._device,
        )


@wp.func
def forward_solve(lower: wp.types.matrix(shape=(6, 6), dtype=wp.float32), b: vec6) -> vec6:
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
def make_kernel(branches: int, depth: int, lanes: int) -> wp.Kernel:
    """Return the kernel for a robot's structure; for the arguments see :func:`~.step.make_kernel`.

    With the inertia matrix as an arrow, J M^-1 J^T of a body on a branch is that of the branch alone, with its trunk
    held, plus what the trunk's motion adds, seen through the branch: u^T S^-1 u, S being the trunk's six equations.
    """
    per_lane = -(-branches // lanes)
    dynamics, algebra = branch_dynamics(depth), linear_algebra(depth)
    vector, matrix, column = dynamics.vector, dynamics.matrix, dynamics.column
    Branch, make_branch = dynamics.Branch, dynamics.make_branch
    cholesky, cholesky_solve = algebra.cholesky, algebra.cholesky_solve
    cholesky6 = linear_algebra(6).cholesky
    matrix6 = linear_algebra(6).matrix

    @wp.func
    def inverse_weight(
        branch: Branch, factor: matrix, trunk_factor: matrix6, jac_lin: wp.vec3, jac_ang: wp.vec3, jac: vector
    ) -> float:
        """Return j M^-1 j^T of one row j = (trunk's translation, trunk's rotation, branch)."""
        solved = cholesky_solve(factor, jac)
        lin = jac_lin - branch.mass_lin * solved
        ang = jac_ang - branch.mass_ang * solved
        u = forward_solve(trunk_factor, vec6(lin[0], lin[1], lin[2], ang[0], ang[1], ang[2]))
        return wp.dot(jac, solved) + wp.dot(u, u)

    @wp.func
    def body_inverse_weights(
        branch: Branch, factor: matrix, trunk_factor: matrix6, rot: wp.mat33, com: wp.vec3, body_depth: int
    ) -> wp.vec2:
        """Return the mean inverse weights of a body's centre of mass against translation, and of its rotation."""
        lever = -skew(com) * rot
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

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def derive_constants(
        robot: Robot, mask: wp.array(dtype=wp.bool), qpos: wp.array2d(dtype=float), rest: wp.array2d(dtype=float),
        body_invweight0: wp.array2d(dtype=wp.vec2), dof_invweight0: wp.array2d(dtype=float),
    ):  # fmt: skip
        world, lane = wp.tid()
        if mask[world]:
            positions = wp.zeros(shape=wp.static(depth + 1), dtype=wp.vec3)
            rotations = wp.zeros(shape=wp.static(depth + 1), dtype=wp.mat33)
            unused = wp.zeros(shape=wp.static(depth + 1), dtype=wp.vec3)
            trunk = make_trunk(robot, world, qpos, rest)
            total = Body()
            lin = wp.mat33()
            coupling = wp.mat33()
            ang = wp.mat33()
            for i in range(wp.static(per_lane)):
                if lane + i * wp.static(lanes) < wp.static(branches):
                    leg = make_branch(
                        robot, world, lane + i * wp.static(lanes), trunk, qpos, rest, rest, positions, rotations,
                        unused, unused,
                    )  # fmt: skip
                    total = add_bodies(total, leg.total)
                    factor = cholesky(leg.mass)
                    for r in range(3):
                        row_lin = vector()
                        row_ang = vector()
                        for j in range(wp.static(depth)):
                            row_lin[j] = leg.mass_lin[r, j]
                            row_ang[j] = leg.mass_ang[r, j]
                        from_lin = leg.mass_lin * cholesky_solve(factor, row_lin)
                        from_ang = leg.mass_ang * cholesky_solve(factor, row_lin)
                        from_both = leg.mass_ang * cholesky_solve(factor, row_ang)
                        for c in range(3):
                            lin[r, c] -= from_lin[c]
                            coupling[r, c] -= from_ang[c]
                            ang[r, c] -= from_both[c]
            whole = whole_body(trunk, total, wp.static(lanes))
            lin = group_sum33_symmetric(lin, wp.static(lanes)) + whole.mass * wp.identity(n=3, dtype=float)
            coupling = group_sum33(coupling, wp.static(lanes)) + whole.coupling
            ang = group_sum33_symmetric(ang, wp.static(lanes)) + whole.rotation
            system = matrix6()
            for r in range(3):
                for c in range(3):
                    system[r, c] = lin[r, c]
                    system[r + 3, c] = coupling[c, r]
                    system[r, c + 3] = coupling[r, c]
                    system[r + 3, c + 3] = ang[r, c]
            trunk_factor = cholesky6(system)
            if lane == 0:
                mean_lin = float(0.0)
                mean_ang = float(0.0)
                for r in range(6):
                    unit6 = vec6()
                    unit6[r] = 1.0
                    u = forward_solve(trunk_factor, unit6)
                    mean_lin += wp.where(r < 3, wp.dot(u, u) / 3.0, 0.0)
                    mean_ang += wp.where(r < 3, 0.0, wp.dot(u, u) / 3.0)
                for r in range(3):
                    dof_invweight0[world, r] = mean_lin
                    dof_invweight0[world, r + 3] = mean_ang
                com = trunk.rot * robot.body_ipos[row(world, robot.body_ipos.shape[0]), 1]
                body_invweight0[world, 1] = body_inverse_weights(Branch(), matrix(), trunk_factor, trunk.rot, com, 0)
            for i in range(wp.static(per_lane)):
                branch = lane + i * wp.static(lanes)
                if branch < wp.static(branches):
                    leg = make_branch(
                        robot, world, branch, trunk, qpos, rest, rest, positions, rotations, unused, unused
                    )
                    factor = cholesky(leg.mass)
                    for j in range(wp.static(depth)):
                        joint = robot.branch_joint[branch, j]
                        unit = vector()
                        unit[j] = 1.0
                        dof_invweight0[world, joint + 5] = inverse_weight(
                            leg, factor, trunk_factor, wp.vec3(0.0), wp.vec3(0.0), unit
                        )
                        rot = rotations[j + 1]
                        com = positions[j + 1] + rot * robot.body_ipos[row(world, robot.body_ipos.shape[0]), joint + 1]
                        body_invweight0[world, joint + 1] = body_inverse_weights(
                            leg, factor, trunk_factor, trunk.rot, com, j + 1
                        )

    return derive_constants
