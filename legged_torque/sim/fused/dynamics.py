"""Kinematics, inertia and forces of a trunk with branches: eq. M qacc + bias = torques + J^T f, in blocks per branch.

All spatial quantities stand in world axes and about the trunk's origin. The trunk's rotational degrees of freedom are
about its own axes, as in MuJoCo; they are turned into world axes where they enter.
"""

import functools
from types import SimpleNamespace

import warp as wp

from legged_torque.sim.fused.math import quat_multiply, quat_rotation, quat_to_matrix, row
from legged_torque.sim.fused.robot import Robot


@wp.struct
class Body:
    """Inertia of a body and the wrench that gravity and velocities need, about the trunk's origin."""

    mass: wp.float32
    moment: wp.vec3
    inertia: wp.mat33
    force: wp.vec3
    torque: wp.vec3


@wp.struct
class Trunk:
    """State and inertia of the trunk."""

    pos: wp.vec3  # in the world [m]
    quat: wp.quat
    rot: wp.mat33  # from the trunk's axes to the world's
    lin_vel: wp.vec3
    ang_vel: wp.vec3  # in world axes
    body: Body


@wp.func
def body_dynamics(
    robot: Robot, world: int, body: int, pos: wp.vec3, rot: wp.mat33, ang: wp.vec3, lin: wp.vec3, ang_acc: wp.vec3,
    lin_acc: wp.vec3,
) -> Body:  # fmt: skip
    """Return a body's inertia and wrench (Newton-Euler) from its pose, velocity and acceleration."""
    out = Body()
    out.mass = robot.body_mass[row(world, robot.body_mass.shape[0]), body]
    com = pos + rot * robot.body_ipos[row(world, robot.body_ipos.shape[0]), body]
    principal = rot * quat_to_matrix(robot.body_iquat[row(world, robot.body_iquat.shape[0]), body])
    diagonal = robot.body_inertia[row(world, robot.body_inertia.shape[0]), body]
    out.moment = out.mass * com
    out.inertia = principal * wp.diag(diagonal) * wp.transpose(principal)
    out.inertia += out.mass * (wp.dot(com, com) * wp.identity(n=3, dtype=float) - wp.outer(com, com))
    momentum_ang = out.inertia * ang + wp.cross(out.moment, lin)
    momentum_lin = out.mass * lin + wp.cross(ang, out.moment)
    out.force = out.mass * lin_acc + wp.cross(ang_acc, out.moment) + wp.cross(ang, momentum_lin)
    out.torque = out.inertia * ang_acc + wp.cross(out.moment, lin_acc)
    out.torque += wp.cross(ang, momentum_ang) + wp.cross(lin, momentum_lin)
    return out


@wp.func
def make_trunk(robot: Robot, world: int, qpos: wp.array2d(dtype=float), qvel: wp.array2d(dtype=float)) -> Trunk:
    """Return the trunk's state, inertia and wrench, without its branches."""
    trunk = Trunk()
    trunk.pos = wp.vec3(qpos[world, 0], qpos[world, 1], qpos[world, 2])
    trunk.quat = wp.normalize(wp.quat(qpos[world, 3], qpos[world, 4], qpos[world, 5], qpos[world, 6]))
    trunk.rot = quat_to_matrix(trunk.quat)
    trunk.lin_vel = wp.vec3(qvel[world, 0], qvel[world, 1], qvel[world, 2])
    trunk.ang_vel = trunk.rot * wp.vec3(qvel[world, 3], qvel[world, 4], qvel[world, 5])
    acc = wp.cross(trunk.lin_vel, trunk.ang_vel) - robot.gravity[row(world, robot.gravity.shape[0])]
    trunk.body = body_dynamics(
        robot, world, 1, wp.vec3(0.0), trunk.rot, trunk.ang_vel, trunk.lin_vel, wp.vec3(0.0), acc
    )
    return trunk


@wp.func
def add_bodies(a: Body, b: Body) -> Body:
    """Return the sum of inertias and wrenches."""
    a.mass += b.mass
    a.moment = a.moment + b.moment
    a.inertia = a.inertia + b.inertia
    a.force = a.force + b.force
    a.torque = a.torque + b.torque
    return a


@functools.cache
def branch_dynamics(n: int) -> SimpleNamespace:
    """Return the types and functions for branches of ``n`` joints.

    Returns:
        ``Branch``, ``Poses`` and ``make_branch(...) -> Branch``, which also fills the poses of its bodies.
    """
    vector = wp.types.vector(length=n, dtype=wp.float32)
    matrix = wp.types.matrix(shape=(n, n), dtype=wp.float32)
    columns = wp.types.matrix(shape=(3, n), dtype=wp.float32)
    symmetric = wp.types.matrix(shape=(6, n), dtype=wp.float32)

    @wp.struct
    class Branch:
        """Equations of motion of one branch, and what it adds to the trunk's."""

        axis: columns  # of each joint, in the world
        lever: columns  # velocity at the trunk's origin per unit of joint velocity
        mass: matrix
        mass_lin: columns  # coupling with the trunk's translation
        mass_ang: columns  # and with its rotation, in the trunk's axes
        force: vector  # torques, springs and dampers less the bias [N m]
        damping: vector
        total: Body

    @wp.func
    def column(m: columns, j: int) -> wp.vec3:
        return wp.vec3(m[0, j], m[1, j], m[2, j])

    @wp.func
    def with_column(m: columns, j: int, v: wp.vec3) -> columns:
        m[0, j] = v[0]
        m[1, j] = v[1]
        m[2, j] = v[2]
        return m

    @wp.func
    def with_symmetric(m: symmetric, j: int, a: wp.mat33) -> symmetric:
        m[0, j] = a[0, 0]
        m[1, j] = a[0, 1]
        m[2, j] = a[0, 2]
        m[3, j] = a[1, 1]
        m[4, j] = a[1, 2]
        m[5, j] = a[2, 2]
        return m

    @wp.func
    def symmetric_matrix(m: symmetric, j: int) -> wp.mat33:
        return wp.mat33(m[0, j], m[1, j], m[2, j], m[1, j], m[3, j], m[4, j], m[2, j], m[4, j], m[5, j])

    @wp.func
    def joint_force(
        robot: Robot, world: int, branch: int, j: int, pos: float, vel: float, ctrl: wp.array2d(dtype=float)
    ) -> float:
        """Return the torque of a joint's motor, spring and damper."""
        joint = robot.branch_joint[branch, j]
        spring = robot.qpos_spring[row(world, robot.qpos_spring.shape[0]), joint + 6]
        force = robot.jnt_stiffness[row(world, robot.jnt_stiffness.shape[0]), joint] * (spring - pos)
        force -= robot.dof_damping[row(world, robot.dof_damping.shape[0]), joint + 5] * vel
        motor = robot.branch_actuator[branch, j]
        if motor >= 0:
            ctrl_range = robot.actuator_ctrlrange[row(world, robot.actuator_ctrlrange.shape[0]), motor]
            force_range = robot.actuator_forcerange[row(world, robot.actuator_forcerange.shape[0]), motor]
            gear = robot.actuator_gear[row(world, robot.actuator_gear.shape[0]), motor][0]
            torque = wp.clamp(ctrl[world, motor], ctrl_range[0], ctrl_range[1])
            force += gear * wp.clamp(torque, force_range[0], force_range[1])
        return force

    @wp.func
    def make_branch(
        robot: Robot, world: int, branch: int, trunk: Trunk, qpos: wp.array2d(dtype=float),
        qvel: wp.array2d(dtype=float), ctrl: wp.array2d(dtype=float), positions: wp.array(dtype=wp.vec3),
        rotations: wp.array(dtype=wp.mat33), ang_vels: wp.array(dtype=wp.vec3), lin_vels: wp.array(dtype=wp.vec3),
    ) -> Branch:  # fmt: skip
        """Return a branch's equations of motion; fill poses and velocities of its bodies, the trunk's at index 0."""
        out = Branch()
        masses = vector()
        moments = columns()
        inertias = symmetric()
        forces = columns()
        torques = columns()
        pos = wp.vec3(0.0)
        quat, ang, lin = 1.0 * trunk.quat, 1.0 * trunk.ang_vel, 1.0 * trunk.lin_vel  # values, not references
        ang_acc = wp.vec3(0.0)
        lin_acc = wp.cross(lin, ang) - robot.gravity[row(world, robot.gravity.shape[0])]
        positions[0] = pos
        rotations[0] = trunk.rot
        ang_vels[0] = ang
        lin_vels[0] = lin
        for j in range(wp.static(n)):
            joint = robot.branch_joint[branch, j]
            body = joint + 1
            angle = qpos[world, joint + 6]
            vel = qvel[world, joint + 5]
            pos += quat_to_matrix(quat) * robot.body_pos[row(world, robot.body_pos.shape[0]), body]
            quat = quat_multiply(quat, robot.body_quat[row(world, robot.body_quat.shape[0]), body])
            local_anchor = robot.jnt_pos[row(world, robot.jnt_pos.shape[0]), joint]
            local_axis = robot.jnt_axis[row(world, robot.jnt_axis.shape[0]), joint]
            anchor = pos + quat_to_matrix(quat) * local_anchor
            turned = angle - robot.qpos0[row(world, robot.qpos0.shape[0]), joint + 6]
            quat = quat_multiply(quat, quat_rotation(local_axis, turned))
            rot = quat_to_matrix(quat)
            pos = anchor - rot * local_anchor
            axis = rot * local_axis
            lever = wp.cross(anchor, axis)
            ang_acc += wp.cross(ang, axis) * vel
            lin_acc += (wp.cross(ang, lever) + wp.cross(lin, axis)) * vel
            ang += axis * vel
            lin += lever * vel
            part = body_dynamics(robot, world, body, pos, rot, ang, lin, ang_acc, lin_acc)
            masses[j] = part.mass
            moments = with_column(moments, j, part.moment)
            inertias = with_symmetric(inertias, j, part.inertia)
            forces = with_column(forces, j, part.force)
            torques = with_column(torques, j, part.torque)
            positions[j + 1] = pos
            rotations[j + 1] = rot
            ang_vels[j + 1] = ang
            lin_vels[j + 1] = lin
            out.axis = with_column(out.axis, j, axis)
            out.lever = with_column(out.lever, j, lever)
            out.force[j] = joint_force(robot, world, branch, j, angle, vel, ctrl)
            out.damping[j] = robot.dof_damping[row(world, robot.dof_damping.shape[0]), joint + 5]
        total = Body()
        for reverse in range(wp.static(n)):
            j = wp.static(n - 1) - reverse
            total.mass += masses[j]
            total.moment += column(moments, j)
            total.inertia += symmetric_matrix(inertias, j)
            total.force += column(forces, j)
            total.torque += column(torques, j)
            axis, lever = column(out.axis, j), column(out.lever, j)
            out.force[j] -= wp.dot(axis, total.torque) + wp.dot(lever, total.force)
            torque = total.inertia * axis + wp.cross(total.moment, lever)
            force = total.mass * lever + wp.cross(axis, total.moment)
            for i in range(wp.static(n)):
                if i <= j:
                    coupling = wp.dot(column(out.axis, i), torque) + wp.dot(column(out.lever, i), force)
                    out.mass[i, j] = coupling
                    out.mass[j, i] = coupling
            out.mass_lin = with_column(out.mass_lin, j, force)
            out.mass_ang = with_column(out.mass_ang, j, wp.transpose(trunk.rot) * torque)
            dof = robot.branch_joint[branch, j] + 5
            out.mass[j, j] += robot.dof_armature[row(world, robot.dof_armature.shape[0]), dof]
        out.total = total
        return out

    return SimpleNamespace(
        vector=vector, matrix=matrix, columns=columns, Branch=Branch, column=column, with_column=with_column,
        make_branch=make_branch,
    )  # fmt: skip
