"""What MuJoCo's ``mj_setConst`` derives from masses: inverse weights, recomputed in the worlds whose masses changed."""

import functools
from types import SimpleNamespace

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from legged_torque.sim.fused.dynamics import Body, Trunk, add_bodies, body_dynamics, branch_dynamics, make_trunk
from legged_torque.sim.fused.math import linear_algebra, row, vec6
from legged_torque.sim.fused.newton import branch_newton
from legged_torque.sim.fused.robot import Robot, lanes_per_world, make_robot, read_tree
from legged_torque.sim.fused.trunk import TrunkSystem, mat66, trunk_matrix, whole_inertia
from legged_torque.sim.per_world import expand

KINDS = 3
"""Inverse weights per body: of its translation, of its rotation, of its joint."""
ROWS = 3
"""Rows of Jacobians per inverse weight, their mean: one per axis; the joint's is the same three times."""


class DerivedConstants:
    """Keeps ``body_invweight0`` and ``dof_invweight0`` of every world in step with its other parameters.

    They scale the softness of contacts, limits and dry friction, and follow from masses, inertias and armatures in the
    model's reference pose. Worlds are expected to differ in their trunks and armatures only: branches without armatures
    are measured once, for all worlds, unless :meth:`vary_branches` is called.
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
        self._device = model.qpos0.device
        for name in ("body_invweight0", "dof_invweight0"):
            expand(model, name, num_envs)
        self._branches_and_depth = branches, depth = tree.joints.shape
        lanes = lanes_per_world(branches, self._device.is_cuda)
        self._kernels = make_kernels(branches, depth, lanes)
        self._dim = (num_envs, (depth + 1) * KINDS * lanes)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, mj_model.qpos0[3:7])
        self._rotation = wp.mat33(rotation)
        self._reference_pose = mj_model.qpos0
        self._branches_vary = False
        with wp.ScopedDevice(self._device):
            self._robot = make_robot(mj_model, model, tree)
        self._measure_worlds(1)

    def vary_branches(self) -> None:
        """Expect that worlds differ in their branches as well, from the next :meth:`update` on."""
        self._branches_vary = True
        self._measure_worlds(self._dim[0])

    def update(self, mask: wp.array) -> None:
        """Recompute the constants.

        Args:
            mask: Which worlds. Shape: (num_envs,), bool.
        """
        if self._branches_vary:
            self._measure_branches(mask)
        wp.launch(
            self._kernels.derive_constants,
            dim=self._dim,
            inputs=[self._robot, mask, self._rotation, self._branches, self._coms, ROWS],
            outputs=[self._robot.body_invweight0, self._robot.dof_invweight0],
            device=self._device,
        )

    def _measure_worlds(self, num_worlds: int) -> None:
        """Allocate and measure the branches of all worlds, or of one for all."""
        with wp.ScopedDevice(self._device):
            self._branches = wp.zeros((num_worlds, self._branches_and_depth[0]), dtype=self._kernels.Branch)
            self._coms = wp.zeros((num_worlds, *self._branches_and_depth), dtype=wp.vec3)
            self._qpos = wp.array(np.tile(self._reference_pose, (num_worlds, 1)), dtype=wp.float32)
            self._rest = wp.zeros((num_worlds, len(self._reference_pose) - 1), dtype=wp.float32)
            self._measure_branches(wp.full(num_worlds, True, dtype=wp.bool))

    def _measure_branches(self, mask: wp.array) -> None:
        """Measure the branches of some worlds in the reference pose."""
        wp.launch(
            self._kernels.measure_branches,
            dim=self._branches.shape,
            inputs=[self._robot, mask, self._qpos, self._rest],
            outputs=[self._branches, self._coms],
            device=self._device,
        )


@functools.cache
def make_kernels(branches: int, depth: int, lanes: int) -> SimpleNamespace:
    """Return the kernels for a robot's structure, and the type ``Branch``.

    With the inertia matrix as an arrow, J M^-1 J^T of a body on a branch is that of the branch alone, with its trunk
    held, plus what the trunk's motion adds, seen through the branch: u^T S^-1 u, S being the trunk's six equations.

    A step rarely changes more than a few worlds, so that it is one world's time that counts: a world has a group of
    threads per body of a branch and kind of weight, which all factorize its equations and then take their own rows.
    All of them run the same loop, which is short, since code that runs once must first be fetched.

    Args:
        branches: Number of branches.
        depth: Joints per branch.
        lanes: Threads per group, a power of two; 1 on a CPU.
    """
    per_lane = -(-branches // lanes)
    dynamics, algebra = branch_dynamics(depth), linear_algebra(depth)
    vector, column, Branch, make_branch = dynamics.vector, dynamics.column, dynamics.Branch, dynamics.make_branch
    cholesky_solve, cholesky6, forward_solve6 = (
        algebra.cholesky_solve, linear_algebra(6).cholesky, linear_algebra(6).forward_solve,
    )  # fmt: skip
    Leg, assemble_damping, eliminate = (
        branch_newton(depth).Leg, branch_newton(depth).assemble_damping, branch_newton(depth).eliminate,
    )  # fmt: skip

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def measure_branches(
        robot: Robot, mask: wp.array(dtype=wp.bool), qpos: wp.array2d(dtype=float), rest: wp.array2d(dtype=float),
        measured: wp.array2d(dtype=Branch), coms: wp.array3d(dtype=wp.vec3),
    ):  # fmt: skip
        """Write a branch at rest without its armatures, and its bodies' centres of mass from the trunk's origin."""
        world, index = wp.tid()
        if not mask[world]:
            return
        positions = wp.zeros(shape=wp.static(depth + 1), dtype=wp.vec3)
        rotations = wp.zeros(shape=wp.static(depth + 1), dtype=wp.mat33)
        velocities = wp.zeros(shape=wp.static(depth + 1), dtype=wp.vec3)
        trunk = make_trunk(robot, world, qpos, rest)
        branch = make_branch(robot, world, index, trunk, qpos, rest, rest, positions, rotations, velocities, velocities)
        for j in range(wp.static(depth)):
            joint = robot.branch_joint[index, j]
            branch.mass[j, j] -= robot.dof_armature[row(world, robot.dof_armature.shape[0]), joint + 5]
            ipos = robot.body_ipos[row(world, robot.body_ipos.shape[0]), joint + 1]
            coms[world, index, j] = positions[j + 1] + rotations[j + 1] * ipos
        measured[world, index] = branch

    @wp.func
    def leg_at_rest(robot: Robot, world: int, index: int, measured: wp.array2d(dtype=Branch)) -> Leg:
        """Return a branch with its inertia matrix, armatures included, factorized."""
        leg = Leg()
        leg.branch = measured[row(world, measured.shape[0]), index]
        for j in range(wp.static(depth)):
            dof = robot.branch_joint[index, j] + 5
            leg.branch.mass[j, j] += robot.dof_armature[row(world, robot.dof_armature.shape[0]), dof]
        return assemble_damping(leg, 0.0)

    @wp.func
    def inverse_weight(
        leg: Leg, trunk_factor: mat66, rot: wp.mat33, com: wp.vec3, body_depth: int, kind: int, rows: int
    ) -> float:
        """Return a mean inverse weight of a body.

        Its kind is 0 for the translation of its centre of mass, 1 for its rotation, 2 for its own joint. A row j of a
        Jacobian is (trunk's translation in world axes, its rotation in its own axes, branch); its weight is j M^-1 j^T.
        The trunk (depth 0) has its own translations in the joint's place. The number of rows is an argument so that
        their loop is not unrolled.
        """
        lever = -wp.skew(com) * rot
        weight = float(0.0)
        for r in range(rows):
            unit = wp.vec3()
            unit[r] = 1.0
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
            u = forward_solve6(trunk_factor, vec6(lin[0], lin[1], lin[2], ang[0], ang[1], ang[2]))
            weight += (wp.dot(jac, solved) + wp.dot(u, u)) / 3.0
        return weight

    @wp.func
    def write_weight(
        weight: float, kind: int, world: int, body: int, body_invweight0: wp.array2d(dtype=wp.vec2),
        dof_invweight0: wp.array2d(dtype=float),
    ):  # fmt: skip
        """Write an inverse weight of a body to its places."""
        if kind == 2 and body > 1:
            dof_invweight0[world, body + 4] = weight
        elif kind == 2:
            for r in range(3):
                dof_invweight0[world, r] = weight
        else:
            body_invweight0[world, body][kind] = weight
            if kind == 1 and body == 1:
                for r in range(3):
                    dof_invweight0[world, r + 3] = weight  # the mean is the same about any three axes

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def derive_constants(
        robot: Robot, mask: wp.array(dtype=wp.bool), rot: wp.mat33, measured: wp.array2d(dtype=Branch),
        coms: wp.array3d(dtype=wp.vec3), rows: int, body_invweight0: wp.array2d(dtype=wp.vec2),
        dof_invweight0: wp.array2d(dtype=float),
    ):  # fmt: skip
        world, thread = wp.tid()
        if not mask[world]:
            return
        group = thread // wp.static(lanes)
        lane = thread - group * wp.static(lanes)
        body_depth = group // wp.static(KINDS)
        kind = group - body_depth * wp.static(KINDS)
        still = wp.vec3(0.0)
        trunk = Trunk()
        trunk.rot = rot
        trunk.body = body_dynamics(robot, world, 1, still, rot, still, still, still, still)
        total = Body()
        system = TrunkSystem()
        leg = Leg()
        for i in range(wp.static(per_lane)):
            branch = lane + i * wp.static(lanes)
            if branch < wp.static(branches):
                leg = leg_at_rest(robot, world, branch, measured)
                system = eliminate(leg, system, TrunkSystem())
                total = add_bodies(total, leg.branch.total)
        whole = whole_inertia(trunk, total, wp.static(lanes))
        trunk_factor = cholesky6(trunk_matrix(whole, system, wp.static(lanes)))
        for i in range(wp.static(per_lane)):
            branch = lane + i * wp.static(lanes)
            if branch < wp.static(branches):
                if wp.static(per_lane > 1):  # a CPU's thread has several branches, of which it kept the last one
                    leg = leg_at_rest(robot, world, branch, measured)
                body = int(1)
                com = rot * robot.body_ipos[row(world, robot.body_ipos.shape[0]), 1]
                if body_depth > 0:
                    body = robot.branch_joint[branch, body_depth - 1] + 1
                    com = coms[row(world, coms.shape[0]), branch, body_depth - 1]
                weight = inverse_weight(leg, trunk_factor, rot, com, body_depth, kind, rows)
                write_weight(weight, kind, world, body, body_invweight0, dof_invweight0)

    return SimpleNamespace(Branch=Branch, measure_branches=measure_branches, derive_constants=derive_constants)
