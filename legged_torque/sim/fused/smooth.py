"""Kinematics, inertia and forces of a trunk with branches: eq. M qacc + bias = torques + J^T f, in blocks per branch.

All spatial quantities stand in world axes and about the trunk's origin. The trunk's rotational degrees of freedom are
about its own axes, as in MuJoCo; they are turned into world axes where they enter.
"""

import functools

import warp as wp

from legged_torque.sim.fused.math import column, quat_multiply, quat_rotation, quat_to_matrix, symmetric, with_column
from legged_torque.sim.fused.model import Model, State, dof, of_world, qadr, row
from legged_torque.sim.fused.types import AnyBranch, AnyLinks, Body, Trunk, branch_types


@wp.struct
class Pose:
    """Position of a body from the trunk's origin, orientation, and velocity at the trunk's origin, in world axes."""

    pos: wp.vec3
    rot: wp.mat33
    ang_vel: wp.vec3
    lin_vel: wp.vec3


Poses = wp.array(dtype=Pose)  # of the trunk and of each body of a branch, by depth


@wp.func
def body_dynamics(model: Model, world: int, body: int, pose: Pose, ang_acc: wp.vec3, lin_acc: wp.vec3) -> Body:
    """Return a body's inertia and wrench (Newton-Euler) from its pose, velocity and acceleration."""
    rot, ang, lin = pose.rot, pose.ang_vel, pose.lin_vel
    out = Body()
    out.mass = of_world(model.body_mass, world, body)
    com = pose.pos + rot * of_world(model.body_ipos, world, body)
    principal = rot * quat_to_matrix(of_world(model.body_iquat, world, body))
    diagonal = of_world(model.body_inertia, world, body)
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
def add_bodies(a: Body, b: Body) -> Body:
    """Return the sum of inertias and wrenches."""
    a.mass += b.mass
    a.moment = a.moment + b.moment
    a.inertia = a.inertia + b.inertia
    a.force = a.force + b.force
    a.torque = a.torque + b.torque
    return a


@wp.func
def trunk_pose(trunk: Trunk) -> Pose:
    """Return the trunk's pose."""
    pose = Pose()
    pose.rot = trunk.rot
    pose.ang_vel = trunk.ang_vel
    pose.lin_vel = trunk.lin_vel
    return pose


@wp.func
def trunk_acc(model: Model, world: int, trunk: Trunk) -> wp.vec3:
    """Return the linear acceleration at the trunk's origin without forces: gravity, and that of rotating axes."""
    return wp.cross(trunk.lin_vel, trunk.ang_vel) - model.gravity[row(world, model.gravity.shape[0])]


@wp.func
def make_trunk(model: Model, state: State, world: int) -> Trunk:
    """Return the trunk's state, inertia and wrench, without its branches."""
    qpos, qvel = state.qpos, state.qvel
    trunk = Trunk()
    trunk.pos = wp.vec3(qpos[world, 0], qpos[world, 1], qpos[world, 2])
    trunk.quat = wp.normalize(wp.quat(qpos[world, 3], qpos[world, 4], qpos[world, 5], qpos[world, 6]))
    trunk.rot = quat_to_matrix(trunk.quat)
    trunk.lin_vel = wp.vec3(qvel[world, 0], qvel[world, 1], qvel[world, 2])
    trunk.ang_vel = trunk.rot * wp.vec3(qvel[world, 3], qvel[world, 4], qvel[world, 5])
    acc = trunk_acc(model, world, trunk)
    trunk.body = body_dynamics(model, world, 1, trunk_pose(trunk), wp.vec3(0.0), acc)
    return trunk


@wp.func
def has_torques(state: State, world: int) -> bool:
    """Return whether a world's motors act: MuJoCo sets all of them to zero where one has no number."""
    is_nan = bool(False)
    for i in range(state.ctrl.shape[1]):
        is_nan = is_nan or wp.isnan(state.ctrl[world, i])
    return not is_nan


@wp.func
def joint_force(
    model: Model, world: int, b: int, j: int, pos: float, vel: float, ctrl: wp.array2d(dtype=float), driven: bool
) -> float:
    """Return the torque of a joint's spring, damper and, if ``driven``, motor."""
    joint = model.branch_joint[b, j]
    spring = of_world(model.qpos_spring, world, qadr(joint))
    force = of_world(model.jnt_stiffness, world, joint) * (spring - pos)
    force -= of_world(model.dof_damping, world, dof(joint)) * vel
    motor = model.branch_actuator[b, j]
    if driven and motor >= 0:
        ctrl_range = of_world(model.actuator_ctrlrange, world, motor)
        force_range = of_world(model.actuator_forcerange, world, motor)
        gear = of_world(model.actuator_gear, world, motor)[0]
        torque = wp.clamp(ctrl[world, motor], ctrl_range[0], ctrl_range[1])
        force += gear * wp.clamp(torque, force_range[0], force_range[1])
    return force


@wp.func
def turn_hinge(model: Model, world: int, joint: int, angle: float, pos: wp.vec3, quat: wp.quat):
    """Return position and orientation of the body behind a hinge from its parent's, and the anchor and axis."""
    body = joint + 1
    origin = pos + quat_to_matrix(quat) * of_world(model.body_pos, world, body)
    unturned = quat_multiply(quat, of_world(model.body_quat, world, body))
    local_anchor = of_world(model.jnt_pos, world, joint)
    local_axis = of_world(model.jnt_axis, world, joint)
    anchor = origin + quat_to_matrix(unturned) * local_anchor
    turned = angle - of_world(model.qpos0, world, qadr(joint))
    out = quat_multiply(unturned, quat_rotation(local_axis, turned))
    rot = quat_to_matrix(out)
    return anchor - rot * local_anchor, out, anchor, rot * local_axis


@functools.cache
def links_maker(n: int) -> wp.Function:
    """Return ``make_links`` for branches of ``n`` joints; a generic function would copy the poses."""
    Branch, Links, _ = branch_types(n)

    @wp.func
    def make_links(model: Model, state: State, world: int, b: int, joints: int, trunk: Trunk, poses: Poses):
        """Return a branch with its joints, and its bodies, and write their poses. Entries without a joint stay zero."""
        branch = Branch()
        links = Links()
        pose = trunk_pose(trunk)
        quat, ang, lin = 1.0 * trunk.quat, 1.0 * trunk.ang_vel, 1.0 * trunk.lin_vel  # values, not references
        pos = wp.vec3(0.0)
        ang_acc = wp.vec3(0.0)
        lin_acc = trunk_acc(model, world, trunk)
        driven = has_torques(state, world)
        poses[0] = pose
        for j in range(wp.static(n)):
            if j < joints:
                joint = model.branch_joint[b, j]
                angle = state.qpos[world, qadr(joint)]
                vel = state.qvel[world, dof(joint)]
                pos, quat, anchor, axis = turn_hinge(model, world, joint, angle, pos, quat)
                lever = wp.cross(anchor, axis)
                ang_acc += wp.cross(ang, axis) * vel
                lin_acc += (wp.cross(ang, lever) + wp.cross(lin, axis)) * vel
                ang += axis * vel
                lin += lever * vel
                pose.pos = pos
                pose.rot = quat_to_matrix(quat)
                pose.ang_vel = ang
                pose.lin_vel = lin
                poses[j + 1] = pose
                body = body_dynamics(model, world, joint + 1, pose, ang_acc, lin_acc)
                links.mass[j] = body.mass
                links.moment = with_column(links.moment, j, body.moment)
                links.inertia_diagonal = with_column(links.inertia_diagonal, j, wp.get_diag(body.inertia))
                rest = wp.vec3(body.inertia[0, 1], body.inertia[0, 2], body.inertia[1, 2])
                links.inertia_rest = with_column(links.inertia_rest, j, rest)
                links.force = with_column(links.force, j, body.force)
                links.torque = with_column(links.torque, j, body.torque)
                branch.smooth.axis = with_column(branch.smooth.axis, j, axis)
                branch.smooth.lever = with_column(branch.smooth.lever, j, lever)
                branch.smooth.force[j] = joint_force(model, world, b, j, angle, vel, state.ctrl, driven)
                branch.smooth.damping[j] = of_world(model.dof_damping, world, dof(joint))
        return branch, links

    return make_links


@wp.func
def make_equations(branch: AnyBranch, links: AnyLinks, model: Model, world: int, b: int, joints: int, rot: wp.mat33):
    """Return a branch with its equations of motion, summed from its last body to its first.

    Entries without a joint get an equation of their own, whose solution is zero.
    """
    smooth = branch.smooth
    total = Body()
    for reverse in range(len(branch.acc)):
        j = len(branch.acc) - 1 - reverse
        total.mass += links.mass[j]
        total.moment += column(links.moment, j)
        total.inertia += symmetric(column(links.inertia_diagonal, j), column(links.inertia_rest, j))
        total.force += column(links.force, j)
        total.torque += column(links.torque, j)
        axis, lever = column(smooth.axis, j), column(smooth.lever, j)
        smooth.force[j] -= wp.dot(axis, total.torque) + wp.dot(lever, total.force)
        torque = total.inertia * axis + wp.cross(total.moment, lever)
        force = total.mass * lever + wp.cross(axis, total.moment)
        for i in range(len(branch.acc)):
            if i <= j:
                coupling = wp.dot(column(smooth.axis, i), torque) + wp.dot(column(smooth.lever, i), force)
                smooth.mass[i, j] = coupling
                smooth.mass[j, i] = coupling
        smooth.mass_lin = with_column(smooth.mass_lin, j, force)
        smooth.mass_ang = with_column(smooth.mass_ang, j, wp.transpose(rot) * torque)
        if j < joints:
            smooth.mass[j, j] += of_world(model.dof_armature, world, dof(model.branch_joint[b, j]))
        else:
            smooth.mass[j, j] = 1.0
    smooth.total = total
    branch.smooth = smooth
    return branch


@wp.func
def wrench_on(model: Model, state: State, world: int, body: int, pose: Pose):
    """Return the force on a body, at its centre of mass, and the torque about the trunk's origin."""
    wrench = state.xfrc_applied[world, body]
    force = wp.vec3(wrench[0], wrench[1], wrench[2])
    com = pose.pos + pose.rot * of_world(model.body_ipos, world, body)
    return force, wp.vec3(wrench[3], wrench[4], wrench[5]) + wp.cross(com, force)


@wp.func
def apply_to_trunk(model: Model, state: State, world: int, trunk: Trunk) -> Trunk:
    """Return the trunk with the forces on it; generalized torques are about its own axes."""
    force, torque = wrench_on(model, state, world, 1, trunk_pose(trunk))
    qfrc = state.qfrc_applied
    force += wp.vec3(qfrc[world, 0], qfrc[world, 1], qfrc[world, 2])
    torque += trunk.rot * wp.vec3(qfrc[world, 3], qfrc[world, 4], qfrc[world, 5])
    trunk.body.force = trunk.body.force - force
    trunk.body.torque = trunk.body.torque - torque
    return trunk


@wp.func
def apply_to_branch(
    branch: AnyBranch, links: AnyLinks, model: Model, state: State, world: int, b: int, joints: int, poses: Poses
):
    """Return a branch and its bodies with the forces on them."""
    for j in range(len(branch.acc)):
        if j < joints:
            joint = model.branch_joint[b, j]
            branch.smooth.force[j] += state.qfrc_applied[world, dof(joint)]
            force, torque = wrench_on(model, state, world, joint + 1, poses[j + 1])
            links.force = with_column(links.force, j, column(links.force, j) - force)
            links.torque = with_column(links.torque, j, column(links.torque, j) - torque)
    return branch, links
