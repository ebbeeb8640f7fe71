"""From accelerations to the state after a step, and to what the contact sensors say."""

import warp as wp

from legged_torque.sim.fused.contact import contact_force, contact_normal
from legged_torque.sim.fused.math import quat_multiply, quat_rotation
from legged_torque.sim.fused.solver import branch_step
from legged_torque.sim.fused.tables import Tables, Worlds, dof, qadr
from legged_torque.sim.fused.trunk import TrunkMotion
from legged_torque.sim.fused.types import AnyBranch, AnyContacts, Trunk


@wp.func
def integrate_trunk(timestep: float, worlds: Worlds, world: int, trunk: Trunk, acc: TrunkMotion, damped: TrunkMotion):
    """Write the trunk's state after the step: velocities first, then positions with the new velocities.

    ``damped`` is what implicit damping adds to the accelerations; the next solution starts without it, as in MuJoCo.
    """
    lin = trunk.lin_vel + timestep * (acc.lin + damped.lin)
    ang = wp.transpose(trunk.rot) * trunk.ang_vel + timestep * (acc.ang + damped.ang)
    speed = wp.length(ang)
    quat = 1.0 * trunk.quat
    if speed > 0.0:
        quat = wp.normalize(quat_multiply(quat, quat_rotation(ang / speed, timestep * speed)))
    for r in range(3):
        worlds.qacc_warmstart[world, r] = acc.lin[r]
        worlds.qacc_warmstart[world, 3 + r] = acc.ang[r]
        worlds.qvel[world, r] = lin[r]
        worlds.qvel[world, 3 + r] = ang[r]
        worlds.qpos[world, r] = worlds.qpos[world, r] + timestep * lin[r]
    for r in range(4):
        worlds.qpos[world, 3 + r] = quat[r]


@wp.func
def integrate_branch(
    tables: Tables, worlds: Worlds, world: int, b: int, joints: int, branch: AnyBranch, damped: TrunkMotion
):
    """Write a branch's state after the step, given what implicit damping adds to the trunk's accelerations."""
    change = branch_step(branch, damped)
    for j in range(len(branch.acc)):
        if j < joints:
            joint = tables.branch_joint[b, j]
            vel = worlds.qvel[world, dof(joint)] + tables.timestep * (branch.acc[j] + change[j])
            worlds.qacc_warmstart[world, dof(joint)] = branch.acc[j]
            worlds.qvel[world, dof(joint)] = vel
            worlds.qpos[world, qadr(joint)] = worlds.qpos[world, qadr(joint)] + tables.timestep * vel


@wp.func
def sense_branch(tables: Tables, worlds: Worlds, world: int, b: int, branch: AnyBranch, contacts: AnyContacts):
    """Write the contact sensors of a branch's geoms: number of contacts, and the sum of their forces."""
    for k in range(tables.point_count[b]):
        address = tables.geom_sensor[tables.point_geom[b, k]]
        if address >= 0:
            for r in range(4):
                worlds.sensordata[world, address + r] = 0.0
    for k in range(branch.first_contact, branch.first_contact + branch.num_contacts):
        address = contacts.found[k].sensor
        if address >= 0:
            force = contact_force(
                contacts.found[k], contact_normal(contacts, k), contacts.residual[k], contacts.pushing[k]
            )
            worlds.sensordata[world, address] = worlds.sensordata[world, address] + 1.0
            for r in range(3):
                worlds.sensordata[world, address + 1 + r] = worlds.sensordata[world, address + 1 + r] + force[r]
