"""What comes before and after the solver: from a state to a branch's equations, and from accelerations to a state."""

import functools
from types import SimpleNamespace

import warp as wp

from legged_torque.sim.fused.constraints import Contact, branch_constraints, contact_force
from legged_torque.sim.fused.dynamics import Trunk, branch_dynamics
from legged_torque.sim.fused.math import quat_multiply, quat_rotation, vec4
from legged_torque.sim.fused.newton import branch_newton
from legged_torque.sim.fused.robot import Robot
from legged_torque.sim.fused.trunk import TrunkMotion


@wp.func
def integrate_trunk(
    robot: Robot, world: int, trunk: Trunk, acc: TrunkMotion, damped: TrunkMotion, qpos: wp.array2d(dtype=float),
    qvel: wp.array2d(dtype=float), warmstart: wp.array2d(dtype=float),
):  # fmt: skip
    """Write the trunk's state after the step: velocities first, then positions with the new velocities.

    ``damped`` is what implicit damping adds to the accelerations; the next solution starts without it, as in MuJoCo.
    """
    lin = trunk.lin_vel + robot.timestep * (acc.lin + damped.lin)
    ang = wp.transpose(trunk.rot) * trunk.ang_vel + robot.timestep * (acc.ang + damped.ang)
    speed = wp.length(ang)
    quat = 1.0 * trunk.quat
    if speed > 0.0:
        quat = wp.normalize(quat_multiply(quat, quat_rotation(ang / speed, robot.timestep * speed)))
    for r in range(3):
        warmstart[world, r] = acc.lin[r]
        warmstart[world, 3 + r] = acc.ang[r]
        qvel[world, r] = lin[r]
        qvel[world, 3 + r] = ang[r]
        qpos[world, r] = qpos[world, r] + robot.timestep * lin[r]
    for r in range(4):
        qpos[world, 3 + r] = quat[r]


@functools.cache
def branch_stages(n: int) -> SimpleNamespace:
    """Return ``make_leg``, ``integrate_leg`` and ``sense_leg`` for branches of ``n`` joints."""
    dynamics, constraints, newton = branch_dynamics(n), branch_constraints(n), branch_newton(n)
    vector, Leg, branch_step = dynamics.vector, newton.Leg, newton.branch_step
    make_branch = dynamics.make_branch
    make_joint_rows, find_contacts = constraints.make_joint_rows, constraints.find_contacts

    @wp.func
    def make_leg(
        robot: Robot, world: int, branch: int, trunk: Trunk, normal: wp.vec3, ctrl: wp.array2d(dtype=float),
        qpos: wp.array2d(dtype=float), qvel: wp.array2d(dtype=float), warmstart: wp.array2d(dtype=float),
        contacts: wp.array(dtype=Contact), first_contact: int,
    ) -> Leg:  # fmt: skip
        """Return a branch with its equations of motion, constraints and the accelerations to start from."""
        positions = wp.zeros(shape=wp.static(n + 1), dtype=wp.vec3)
        rotations = wp.zeros(shape=wp.static(n + 1), dtype=wp.mat33)
        ang_vels = wp.zeros(shape=wp.static(n + 1), dtype=wp.vec3)
        lin_vels = wp.zeros(shape=wp.static(n + 1), dtype=wp.vec3)
        leg = Leg()
        leg.branch = make_branch(
            robot, world, branch, trunk, qpos, qvel, ctrl, positions, rotations, ang_vels, lin_vels
        )
        leg.rows = make_joint_rows(robot, world, branch, qpos, qvel)
        leg.first_contact = first_contact
        leg.num_contacts = find_contacts(
            robot, world, branch, trunk.pos, normal, positions, rotations, ang_vels, lin_vels, contacts, first_contact
        )
        start = vector()
        for j in range(wp.static(n)):
            start[j] = warmstart[world, robot.branch_joint[branch, j] + 5]
        leg.acc = start
        return leg

    @wp.func
    def integrate_leg(
        robot: Robot, world: int, branch: int, leg: Leg, damped: TrunkMotion, qpos: wp.array2d(dtype=float),
        qvel: wp.array2d(dtype=float), warmstart: wp.array2d(dtype=float),
    ):  # fmt: skip
        """Write a branch's state after the step, given what implicit damping adds to the trunk's accelerations."""
        change = branch_step(leg, damped)
        for j in range(wp.static(n)):
            joint = robot.branch_joint[branch, j]
            vel = qvel[world, joint + 5] + robot.timestep * (leg.acc[j] + change[j])
            warmstart[world, joint + 5] = leg.acc[j]
            qvel[world, joint + 5] = vel
            qpos[world, joint + 6] = qpos[world, joint + 6] + robot.timestep * vel

    @wp.func
    def sense_leg(
        robot: Robot, world: int, branch: int, leg: Leg, normal: wp.vec3, contacts: wp.array(dtype=Contact),
        x: wp.array(dtype=vec4), sensordata: wp.array2d(dtype=float),
    ):  # fmt: skip
        """Write the contact sensors of a branch's geoms: number of contacts, and the sum of their forces."""
        for k in range(robot.point_count[branch]):
            address = robot.geom_sensor[robot.point_geom[branch, k]]
            if address >= 0:
                for r in range(4):
                    sensordata[world, address + r] = 0.0
        for k in range(leg.first_contact, leg.first_contact + leg.num_contacts):
            address = contacts[k].sensor
            if address >= 0:
                force = contact_force(contacts[k], normal, x[k])
                sensordata[world, address] = sensordata[world, address] + 1.0
                for r in range(3):
                    sensordata[world, address + 1 + r] = sensordata[world, address + 1 + r] + force[r]

    return SimpleNamespace(make_leg=make_leg, integrate_leg=integrate_leg, sense_leg=sense_leg)
