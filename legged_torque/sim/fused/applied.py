"""Forces that a user applies: MuJoCo's ``xfrc_applied`` on bodies and ``qfrc_applied`` on degrees of freedom."""

import warp as wp

from legged_torque.sim.fused.math import column, with_column
from legged_torque.sim.fused.model import Model, State, dof, of_world
from legged_torque.sim.fused.smooth import Pose, Poses
from legged_torque.sim.fused.types import AnyBranch, AnyLinks, Trunk


@wp.func
def wrench_on(model: Model, state: State, world: int, body: int, pose: Pose):
    """Return the force on a body, at its centre of mass, and the torque about the trunk's origin."""
    wrench = state.xfrc_applied[world, body]
    force = wp.vec3(wrench[0], wrench[1], wrench[2])
    com = pose.pos + pose.rot * of_world(model.body_ipos, world, body)
    return force, wp.vec3(wrench[3], wrench[4], wrench[5]) + wp.cross(com, force)


@wp.func
def apply_to_trunk(model: Model, state: State, world: int, trunk: Trunk, pose: Pose) -> Trunk:
    """Return the trunk with the forces on it; generalized torques are about its own axes."""
    force, torque = wrench_on(model, state, world, 1, pose)
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
