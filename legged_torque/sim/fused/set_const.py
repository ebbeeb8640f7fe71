"""MuJoCo's ``mj_setConst``: inverse weights, recomputed in worlds whose masses have changed."""

import functools
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from torch import Tensor

from legged_torque.sim.fused.layout import Layout, branches_of
from legged_torque.sim.fused.math import cholesky, cholesky_solve, column, forward_solve
from legged_torque.sim.fused.model import Model, State, dof, make_model, of_world, row
from legged_torque.sim.fused.smooth import Pose, add_bodies, body_dynamics, links_maker, make_equations, make_trunk
from legged_torque.sim.fused.solver import assemble_damping, eliminate
from legged_torque.sim.fused.tree import FLOORS, read_tree
from legged_torque.sim.fused.trunk import TrunkSystem, trunk_matrix, whole_inertia
from legged_torque.sim.fused.types import AnyBranch, Body, Trunk, branch_types, mat66, vec6

KINDS = 3  # inverse weights per body: of its translation, of its rotation, of its joint
ROWS = 3  # rows of Jacobians per inverse weight, their mean: one per axis; the joint's is the same three times


class DerivedConstants:
    """Recomputes ``body_invweight0`` and ``dof_invweight0`` of worlds from their other parameters.

    They scale the softness of contacts, limits and dry friction, and follow from masses, inertias and armatures in the
    model's reference pose. Worlds are expected to differ in their trunks and armatures only: branches without armatures
    are measured once, for all worlds, unless :meth:`vary_branches` is called.
    """

    def __init__(self, mj_model: mujoco.MjModel, model: mjw.Model, num_envs: int) -> None:
        """Prepare, while worlds are alike in ``model``, in which both fields have a row per world.

        A UserError if the robot's structure is not a trunk with branches.
        """
        tree = read_tree(mj_model, FLOORS)
        self._device = model.qpos0.device
        self._layout = layout = Layout.of(tree, self._device.is_cuda, on_map=False)
        self._measure, self._derive = make_measure(layout), make_derive(layout)
        self._dim = (num_envs, (layout.depth + 1) * KINDS * layout.threads)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, mj_model.qpos0[3:7])
        self._rotation = wp.mat33(rotation)
        self._reference_pose = mj_model.qpos0
        self._branches_vary = False
        with wp.ScopedDevice(self._device):
            self.model = make_model(mj_model, model, tree)
        self._measure_worlds(1)

    def vary_branches(self) -> None:
        """Take differences between the worlds' branches into account, from the next :meth:`update` on."""
        if not self._branches_vary:
            self._branches_vary = True
            self._measure_worlds(self._dim[0])

    def update(self, worlds: Tensor) -> None:
        """Recompute the constants in some worlds. Shape: (num_envs,), bool."""
        mask: Any = wp.from_torch(worlds)
        if self._branches_vary:
            self._measure_branches(mask)
        inputs = [self.model, mask, self._rotation, self._measured, self._coms, ROWS]
        outputs = [self.model.body_invweight0, self.model.dof_invweight0]
        wp.launch(self._derive, self._dim, inputs, outputs, device=self._device)

    def _measure_worlds(self, num_worlds: int) -> None:
        """Measure the branches of all worlds, or of one that stands for all."""
        branches, depth, *_ = self._layout
        with wp.ScopedDevice(self._device):
            self._measured = wp.zeros((num_worlds, branches), dtype=branch_types(depth).Smooth)
            self._coms = wp.zeros((num_worlds, branches, depth), dtype=wp.vec3)
            self._qpos = wp.array(np.tile(self._reference_pose, (num_worlds, 1)), dtype=wp.float32)
            self._rest = wp.zeros((num_worlds, len(self._reference_pose) - 1), dtype=wp.float32)
            self._measure_branches(wp.full(num_worlds, True, dtype=wp.bool))

    def _measure_branches(self, mask: wp.array) -> None:
        """Measure the branches of some worlds in the reference pose."""
        inputs, outputs = [self.model, mask, self._qpos, self._rest], [self._measured, self._coms]
        wp.launch(self._measure, self._measured.shape, inputs, outputs, device=self._device)


@wp.func
def inverse_weight(
    branch: AnyBranch, trunk_factor: mat66, rot: wp.mat33, com: wp.vec3, body_depth: int, kind: int, rows: int
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
        jac = type(branch.acc)()
        if kind == 0:
            jac_ang = wp.transpose(lever) * unit
        if kind == 1:
            jac_ang = wp.transpose(rot) * unit
        for j in range(len(branch.acc)):
            axis = column(branch.smooth.axis, j)
            if kind == 2:
                jac[j] = wp.where(j == body_depth - 1, 1.0, 0.0)
            elif j < body_depth:
                motion = column(branch.smooth.lever, j) + wp.cross(axis, com)
                jac[j] = wp.dot(wp.where(kind == 0, motion, axis), unit)
        solved = cholesky_solve(branch.factor, jac)
        lin = jac_lin - branch.smooth.mass_lin * solved
        ang = jac_ang - branch.smooth.mass_ang * solved
        u = forward_solve(trunk_factor, vec6(lin[0], lin[1], lin[2], ang[0], ang[1], ang[2]))
        weight += (wp.dot(jac, solved) + wp.dot(u, u)) / 3.0
    return weight


@wp.func
def write_weight(
    weight: float,
    kind: int,
    world: int,
    body: int,
    body_invweight0: wp.array2d(dtype=wp.vec2),
    dof_invweight0: wp.array2d(dtype=float),
):
    """Write an inverse weight of a body to its places."""
    if kind == 2 and body > 1:
        dof_invweight0[world, dof(body - 1)] = weight
    elif kind == 2:
        for r in range(3):
            dof_invweight0[world, r] = weight
    else:
        body_invweight0[world, body][kind] = weight
        if kind == 1 and body == 1:
            for r in range(3):
                dof_invweight0[world, r + 3] = weight  # the mean is the same about any three axes


@wp.func
def branch_at_rest(branch: AnyBranch, model: Model, world: int, b: int, joints: int):
    """Return a branch, with its inertia matrix without armatures, with the factor of the matrix with them."""
    for j in range(len(branch.acc)):
        if j < joints:
            branch.smooth.mass[j, j] += of_world(model.dof_armature, world, dof(model.branch_joint[b, j]))
    return assemble_damping(branch, 0.0)


@functools.cache
def make_measure(layout: Layout) -> wp.Kernel:
    """Return the kernel that measures branches."""
    depth, num_joints = layout.depth, branches_of(layout).num_joints
    Smooth, make_links = branch_types(depth).Smooth, links_maker(depth)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def measure_branches(
        # Model:
        model: Model,
        # In:
        mask: wp.array(dtype=wp.bool),
        qpos: wp.array2d(dtype=float),
        rest: wp.array2d(dtype=float),
        # Out:
        measured: wp.array2d(dtype=Smooth),
        coms: wp.array3d(dtype=wp.vec3),
    ):
        """Write a branch at rest without its armatures, and its bodies' centres of mass from the trunk's origin."""
        world, b = wp.tid()
        if not mask[world]:
            return
        state = State()
        state.ctrl = rest
        state.qpos = qpos
        state.qvel = rest
        poses = wp.zeros(shape=wp.static(depth + 1), dtype=Pose)
        trunk = make_trunk(model, state, world)
        joints = num_joints(model, b)
        branch, links = make_links(model, state, world, b, joints, trunk, poses)
        branch = make_equations(branch, links, model, world, b, joints, trunk.rot)
        for j in range(wp.static(depth)):
            if j < joints:
                joint = model.branch_joint[b, j]
                branch.smooth.mass[j, j] -= of_world(model.dof_armature, world, dof(joint))
                ipos = of_world(model.body_ipos, world, joint + 1)
                coms[world, b, j] = poses[j + 1].pos + poses[j + 1].rot * ipos
        measured[world, b] = branch.smooth

    return measure_branches


@functools.cache
def make_derive(layout: Layout) -> wp.Kernel:
    """Return the kernel that derives the constants.

    With the inertia matrix as an arrow, J M^-1 J^T of a body on a branch is that of the branch alone, with its trunk
    held, plus what the trunk's motion adds, seen through the branch: u^T S^-1 u, S being the trunk's six equations.

    A step rarely changes more than a few worlds, so that it is one world's time that counts: a world has a group of
    threads per body of a branch and kind of weight, which all factorize its equations and then take their own rows.
    All of them run the same loop, which is short, since code that runs once must first be fetched.
    """
    branches, depth, _, threads, _, alike, *_ = layout
    per_thread, num_joints, (Branch, _, Smooth) = layout.per_thread, branches_of(layout).num_joints, branch_types(depth)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def derive_constants(
        # Model:
        model: Model,
        # In:
        mask: wp.array(dtype=wp.bool),
        rot: wp.mat33,
        measured: wp.array2d(dtype=Smooth),
        coms: wp.array3d(dtype=wp.vec3),
        rows: int,
        # Model out:
        body_invweight0: wp.array2d(dtype=wp.vec2),
        dof_invweight0: wp.array2d(dtype=float),
    ):
        world, number = wp.tid()
        if not mask[world]:
            return
        group = number // wp.static(threads)
        thread = number - group * wp.static(threads)
        body_depth = group // wp.static(KINDS)
        kind = group - body_depth * wp.static(KINDS)
        still = Pose()
        still.rot = rot
        trunk = Trunk()
        trunk.rot = rot
        trunk.body = body_dynamics(model, world, 1, still, wp.vec3(0.0), wp.vec3(0.0))
        total = Body()
        system = TrunkSystem()
        branch = Branch()
        for i in range(wp.static(per_thread)):
            b = thread + i * wp.static(threads)
            if b < wp.static(branches):
                branch.smooth = measured[row(world, measured.shape[0]), b]
                branch = branch_at_rest(branch, model, world, b, num_joints(model, b))
                system = eliminate(branch, system, TrunkSystem())
                total = add_bodies(total, branch.smooth.total)
        whole = whole_inertia(trunk, total, wp.static(threads))
        trunk_factor = cholesky(trunk_matrix(whole, system, wp.static(threads)))
        for i in range(wp.static(per_thread)):
            b = thread + i * wp.static(threads)
            if b < wp.static(branches):
                joints = num_joints(model, b)
                if wp.static(per_thread > 1):  # a CPU's thread has several branches, of which it kept the last one
                    branch.smooth = measured[row(world, measured.shape[0]), b]
                    branch = branch_at_rest(branch, model, world, b, joints)
                if wp.static(alike) or body_depth <= joints:
                    body = int(1)
                    com = rot * of_world(model.body_ipos, world, 1)
                    if body_depth > 0:
                        body = model.branch_joint[b, body_depth - 1] + 1
                        com = coms[row(world, coms.shape[0]), b, body_depth - 1]
                    weight = inverse_weight(branch, trunk_factor, rot, com, body_depth, kind, rows)
                    write_weight(weight, kind, world, body, body_invweight0, dof_invweight0)

    return derive_constants
