"""What MuJoCo's ``mj_setConst`` derives from masses: inverse weights, recomputed in the worlds whose masses changed."""

import functools

import mujoco
import mujoco_warp as mjw
import warp as wp

from legged_torque.sim.fused.dynamics import Body, Trunk, add_bodies, body_dynamics, branch_dynamics, make_trunk
from legged_torque.sim.fused.math import linear_algebra, quat_multiply, quat_to_matrix, row, vec6
from legged_torque.sim.fused.newton import branch_newton
from legged_torque.sim.fused.robot import Robot, lanes_per_world, make_robot, read_tree
from legged_torque.sim.fused.trunk import TrunkSystem, mat66, trunk_matrix, whole_inertia
from legged_torque.sim.per_world import expand

ROWS = 9
"""Rows of Jacobians per body: translations, rotations, and three times its joint's own. An argument of the kernel, lest
the compiler unroll their loop."""


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
        self._joints, self._threads = depth, lanes * (depth + 1)
        self._kernel = make_kernel(branches, depth, lanes)
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
            inputs=[self._robot, mask, self._reference, self._rest, self._joints, ROWS],
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
def make_kernel(branches: int, depth: int, lanes: int) -> wp.Kernel:
    """Return the kernel for a robot's structure.

    With the inertia matrix as an arrow, J M^-1 J^T of a body on a branch is that of the branch alone, with its trunk
    held, plus what the trunk's motion adds, seen through the branch: u^T S^-1 u, S being the trunk's six equations.

    A step rarely changes more than a few worlds, so that it is one world's time that counts: a world has a group of
    threads per depth, the trunk's included, which all factorize its equations and then take the rows of their bodies.
    All of them run the same loop, so that threads of a warp do not wait for each other's code.

    Args:
        branches: Number of branches.
        depth: Joints per branch.
        lanes: Threads per group, a power of two; 1 on a CPU.
    """
    per_lane = -(-branches // lanes)
    dynamics, algebra = branch_dynamics(depth), linear_algebra(depth)
    vector, column, with_column, Branch = dynamics.vector, dynamics.column, dynamics.with_column, dynamics.Branch
    cholesky_solve = algebra.cholesky_solve
    Leg, assemble_damping, eliminate = (
        branch_newton(depth).Leg, branch_newton(depth).assemble_damping, branch_newton(depth).eliminate,
    )  # fmt: skip

    @wp.func
    def leg_at_rest(
        robot: Robot, world: int, branch: int, joints: int, trunk: Trunk, positions: wp.array(dtype=wp.vec3),
        rotations: wp.array(dtype=wp.mat33),
    ) -> Leg:  # fmt: skip
        """Return a branch with its inertia matrix in the reference pose, factorized; fill the poses of its bodies.

        It is what ``make_branch`` returns at rest, in loops that are not unrolled.
        """
        pos, quat = wp.vec3(0.0), 1.0 * trunk.quat
        positions[0] = pos
        rotations[0] = trunk.rot
        out = Branch()
        for j in range(joints):
            joint = robot.branch_joint[branch, j]
            pos += quat_to_matrix(quat) * robot.body_pos[row(world, robot.body_pos.shape[0]), joint + 1]
            quat = quat_multiply(quat, robot.body_quat[row(world, robot.body_quat.shape[0]), joint + 1])
            rot = quat_to_matrix(quat)
            axis = rot * robot.jnt_axis[row(world, robot.jnt_axis.shape[0]), joint]
            anchor = pos + rot * robot.jnt_pos[row(world, robot.jnt_pos.shape[0]), joint]
            positions[j + 1] = pos
            rotations[j + 1] = rot
            out.axis = with_column(out.axis, j, axis)
            out.lever = with_column(out.lever, j, wp.cross(anchor, axis))
        still = wp.vec3(0.0)
        for reverse in range(joints):
            j = joints - 1 - reverse
            joint = robot.branch_joint[branch, j]
            body = body_dynamics(
                robot, world, joint + 1, positions[j + 1], rotations[j + 1], still, still, still, still
            )
            out.total = add_bodies(out.total, body)
            axis, lever = column(out.axis, j), column(out.lever, j)
            torque = out.total.inertia * axis + wp.cross(out.total.moment, lever)
            force = out.total.mass * lever + wp.cross(axis, out.total.moment)
            for i in range(j + 1):
                out.mass[i, j] = wp.dot(column(out.axis, i), torque) + wp.dot(column(out.lever, i), force)
                out.mass[j, i] = out.mass[i, j]
            out.mass[j, j] += robot.dof_armature[row(world, robot.dof_armature.shape[0]), joint + 5]
            out.mass_lin = with_column(out.mass_lin, j, force)
            out.mass_ang = with_column(out.mass_ang, j, wp.transpose(trunk.rot) * torque)
        leg = Leg()
        leg.branch = out
        return assemble_damping(leg, 0.0)

    @wp.func
    def inverse_weights(
        leg: Leg, trunk_factor: mat66, rot: wp.mat33, com: wp.vec3, body_depth: int, rows: int
    ) -> wp.vec3:
        """Return mean inverse weights: of a body's translation at its centre of mass, its rotation, and its own joint.

        A row j of a Jacobian is (trunk's translation in world axes, its rotation in its own axes, branch); its weight
        is j M^-1 j^T. The trunk (depth 0) has its own translations in the joint's place.
        """
        lever = -wp.skew(com) * rot
        weights = wp.vec3()
        for k in range(rows):
            kind = k // 3
            unit = wp.vec3()
            unit[k - 3 * kind] = 1.0
            jac_lin = wp.where(kind == 0 or (kind == 2 and body_depth == 0), unit, wp.vec3(0.0))
            jac_ang = wp.vec3(0.0)
            jac = vector()
            if kind == 0:
                jac_ang = wp.transpose(lever) * unit
            if kind == 1:
                jac_ang = wp.transpose(rot) * unit
            for j in range(wp.static(depth)):
                axis = column(leg.branch.axis, j)
                if kind == 2:
                    jac[j] = wp.where(j == body_depth - 1, 1.0, 0.0)
                elif j < body_depth:
                    motion = column(leg.branch.lever, j) + wp.cross(axis, com)
                    jac[j] = wp.dot(wp.where(kind == 0, motion, axis), unit)
            solved = cholesky_solve(leg.factor, jac)
            lin = jac_lin - leg.branch.mass_lin * solved
            ang = jac_ang - leg.branch.mass_ang * solved
            u = forward_solve(trunk_factor, vec6(lin[0], lin[1], lin[2], ang[0], ang[1], ang[2]))
            weights[kind] = weights[kind] + (wp.dot(jac, solved) + wp.dot(u, u)) / 3.0
        return weights

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def derive_constants(
        robot: Robot, mask: wp.array(dtype=wp.bool), qpos: wp.array2d(dtype=float), rest: wp.array2d(dtype=float),
        joints: int, rows: int, body_invweight0: wp.array2d(dtype=wp.vec2), dof_invweight0: wp.array2d(dtype=float),
    ):  # fmt: skip
        world, thread = wp.tid()
        if not mask[world]:
            return
        body_depth = thread // wp.static(lanes)
        lane = thread - body_depth * wp.static(lanes)
        positions = wp.zeros(shape=wp.static(depth + 1), dtype=wp.vec3)
        rotations = wp.zeros(shape=wp.static(depth + 1), dtype=wp.mat33)
        trunk = make_trunk(robot, world, qpos, rest)
        total = Body()
        system = TrunkSystem()
        leg = Leg()
        for i in range(wp.static(per_lane)):
            branch = lane + i * wp.static(lanes)
            if branch < wp.static(branches):
                leg = leg_at_rest(robot, world, branch, joints, trunk, positions, rotations)
                system = eliminate(leg, system, TrunkSystem())
                total = add_bodies(total, leg.branch.total)
        whole = whole_inertia(trunk, total, wp.static(lanes))
        trunk_factor = wp.static(linear_algebra(6).cholesky)(trunk_matrix(whole, system, wp.static(lanes)))
        for i in range(wp.static(per_lane)):
            branch = lane + i * wp.static(lanes)
            if branch < wp.static(branches):
                if wp.static(per_lane > 1):  # a CPU's thread has several branches, of which it kept the last one
                    leg = leg_at_rest(robot, world, branch, joints, trunk, positions, rotations)
                body = int(1)
                if body_depth > 0:
                    body = robot.branch_joint[branch, body_depth - 1] + 1
                ipos = robot.body_ipos[row(world, robot.body_ipos.shape[0]), body]
                com = positions[body_depth] + rotations[body_depth] * ipos
                weights = inverse_weights(leg, trunk_factor, trunk.rot, com, body_depth, rows)
                body_invweight0[world, body] = wp.vec2(weights[0], weights[1])
                if body_depth > 0:
                    dof_invweight0[world, body + 4] = weights[2]
                else:
                    for r in range(3):
                        dof_invweight0[world, r] = weights[2]
                        dof_invweight0[world, r + 3] = weights[1]  # the mean is the same about any three axes

    return derive_constants
