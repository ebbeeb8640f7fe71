"""Integration of accelerations to the state after a step, and the contact sensors."""

import warp as wp

from legged_torque.sim.fused.collision import contact_normal
from legged_torque.sim.fused.collision_self import SelfContacts, Touching
from legged_torque.sim.fused.constraint import contact_force
from legged_torque.sim.fused.math import quat_multiply, quat_rotation
from legged_torque.sim.fused.model import Model, State, dof, qadr
from legged_torque.sim.fused.solver import branch_step
from legged_torque.sim.fused.trunk import TrunkMotion
from legged_torque.sim.fused.types import AnyBranch, AnyContacts, Trunk


@wp.func
def integrate_trunk(timestep: float, state: State, world: int, trunk: Trunk, acc: TrunkMotion, damped: TrunkMotion):
    """Write the trunk's state after the step: velocities first, then positions with the new velocities.

    Implicit damping adds ``damped`` to the accelerations; the next solution starts without it, as in MuJoCo.
    """
    lin = trunk.lin_vel + timestep * (acc.lin + damped.lin)
    ang = wp.transpose(trunk.rot) * trunk.ang_vel + timestep * (acc.ang + damped.ang)
    speed = wp.length(ang)
    quat = 1.0 * trunk.quat
    if speed > 0.0:
        quat = wp.normalize(quat_multiply(quat, quat_rotation(ang / speed, timestep * speed)))
    for r in range(3):
        state.qacc_warmstart[world, r] = acc.lin[r]
        state.qacc_warmstart[world, 3 + r] = acc.ang[r]
        state.qvel[world, r] = lin[r]
        state.qvel[world, 3 + r] = ang[r]
        state.qpos[world, r] = state.qpos[world, r] + timestep * lin[r]
    for r in range(4):
        state.qpos[world, 3 + r] = quat[r]


@wp.func
def integrate_branch(
    model: Model, state: State, world: int, b: int, joints: int, branch: AnyBranch, damped: TrunkMotion
):
    """Write a branch's state after the step; implicit damping adds ``damped`` to the trunk's accelerations."""
    change = branch_step(branch, damped)
    for j in range(len(branch.acc)):
        if j < joints:
            joint = model.branch_joint[b, j]
            vel = state.qvel[world, dof(joint)] + model.timestep * (branch.acc[j] + change[j])
            state.qacc_warmstart[world, dof(joint)] = branch.acc[j]
            state.qvel[world, dof(joint)] = vel
            state.qpos[world, qadr(joint)] = state.qpos[world, qadr(joint)] + model.timestep * vel


@wp.func
def add_to_sensor(state: State, world: int, address: int, force: wp.vec3):
    """Add a contact and its force to a contact sensor."""
    state.sensordata[world, address] = state.sensordata[world, address] + 1.0
    for r in range(3):
        state.sensordata[world, address + 1 + r] = state.sensordata[world, address + 1 + r] + force[r]


@wp.func
def sense_branch(model: Model, state: State, world: int, b: int, branch: AnyBranch, contacts: AnyContacts):
    """Write the contact sensors of a branch's geoms: number of contacts, and the sum of their forces."""
    for k in range(model.point_count[b]):
        address = model.geom_sensor[model.point_geom[b, k]]
        if address >= 0:
            for r in range(4):
                state.sensordata[world, address + r] = 0.0
    for k in range(branch.first_contact, branch.first_contact + branch.num_contacts):
        address = contacts.found[k].sensor
        if address >= 0:
            force = contact_force(
                contacts.found[k], contact_normal(contacts, k), contacts.residual[k], contacts.pushing[k]
            )
            add_to_sensor(state, world, address, force)


@wp.func
def sense_self_contacts(model: Model, state: State, world: int, selves: SelfContacts, touching: Touching):
    """Add contacts between parts of the robot to the sensors of both geoms, after those with the ground."""
    for k in range(selves.airborne.shape[0]):
        for r in range(4):
            state.sensordata[world, selves.airborne[k] + r] = 0.0
    for k in range(touching.first, touching.end):
        force = contact_force(selves.found[k], selves.normal[k], selves.residual[k], selves.pushing[k])
        for side in range(2):
            address = model.geom_sensor[selves.pair[selves.of_pair[k]][side]]
            if address >= 0:
                sign = wp.where(side == 0, -1.0, 1.0)
                add_to_sensor(state, world, address, sign * force)
