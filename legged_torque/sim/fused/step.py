"""One physics step as one kernel: a group of threads per world, one thread per leg.

MuJoCo Warp runs a step as some hundred small kernels, which wait for each other and for memory. A legged robot on a
plane is small: a trunk and a few branches of hinge joints that meet only there. Here a thread holds a branch in
registers from kinematics to integration, and the threads of a world add up what concerns the trunk.
"""

import functools

import mujoco
import mujoco_warp as mjw
import warp as wp

from legged_torque.sim.fused.constraints import Contact, branch_constraints, contact_force, floor_normal
from legged_torque.sim.fused.dynamics import (
    branch_dynamics,
    make_trunk,
    trunk_mass_coupling,
    trunk_mass_rotation,
)
from legged_torque.sim.fused.math import (
    group_sum,
    group_sum3,
    group_sum33,
    group_sum33_symmetric,
    quat_multiply,
    quat_rotation,
    vec4,
)
from legged_torque.sim.fused.newton import TrunkMotion, TrunkSystem, branch_newton, clamp_state, solve_trunk
from legged_torque.sim.fused.robot import Robot, make_robot, read_tree

BLOCK_DIM = 64
"""Threads per block; small blocks spread few worlds over the whole GPU."""


class FusedStep:
    """Steps all worlds of a MuJoCo Warp ``Data``, on its own arrays."""

    def __init__(self, mj_model: mujoco.MjModel, model: mjw.Model, data: mjw.Data) -> None:
        """Read the robot's structure and prepare the kernel; it compiles at the first step.

        Args:
            mj_model: The model.
            model: The same on the device; parameters that change there act at once.
            data: The worlds.

        Raises:
            UserError: If the robot has something that this step does not simulate.
        """
        tree = read_tree(mj_model)
        branches, depth = tree.joints.shape
        self._data = data
        self._device = data.qpos.device
        with wp.ScopedDevice(self._device):
            self._robot = make_robot(mj_model, model, tree)
        self._lanes = 1 << (branches - 1).bit_length() if self._device.is_cuda else 1
        points = max(1, *(len(points) for points in tree.points))
        self._kernel = make_kernel(branches, depth, points, self._lanes)
        self._limits = (mj_model.opt.iterations, mj_model.opt.ls_iterations)

    def __call__(self, sense: bool) -> None:
        """Advance every world by one physics step.

        Args:
            sense: Whether to write the contact sensors.
        """
        data = self._data
        wp.launch(
            self._kernel,
            dim=(data.nworld, self._lanes),
            inputs=[self._robot, *self._limits, sense, data.ctrl],
            outputs=[data.qpos, data.qvel, data.qacc_warmstart, data.sensordata, data.solver_niter],
            block_dim=BLOCK_DIM,
            device=self._device,
        )


@functools.cache
def make_kernel(branches: int, depth: int, points: int, lanes: int) -> wp.Kernel:
    """Return the kernel for a robot's structure.

    Args:
        branches: Number of branches.
        depth: Joints per branch.
        points: Most contacts of a branch with the floor.
        lanes: Threads per world, a power of two; 1 on a CPU.
    """
    per_lane = -(-branches // lanes)
    dynamics, constraints, newton = branch_dynamics(depth), branch_constraints(depth), branch_newton(depth)
    vector, Branch = dynamics.vector, dynamics.Branch
    JointRows, Residuals, BranchSystem = constraints.JointRows, newton.Residuals, newton.BranchSystem
    make_branch, make_joint_rows, find_contacts = (
        dynamics.make_branch, constraints.make_joint_rows, constraints.find_contacts,
    )  # fmt: skip
    joint_rows_times, contact_rows_times = newton.joint_rows_times, newton.contact_rows_times
    eliminate, branch_step, row_slopes, move_residuals = (
        newton.eliminate, newton.branch_step, newton.row_slopes, newton.move_residuals,
    )  # fmt: skip

    @wp.kernel(module="unique", enable_backward=False)
    def fused_step(
        robot: Robot, iterations: int, ls_iterations: int, sense: bool, ctrl: wp.array2d(dtype=float),
        qpos: wp.array2d(dtype=float), qvel: wp.array2d(dtype=float), warmstart: wp.array2d(dtype=float),
        sensordata: wp.array2d(dtype=float), niter: wp.array(dtype=int),
    ):  # fmt: skip
        world, lane = wp.tid()
        legs = wp.zeros(shape=wp.static(per_lane), dtype=Branch)
        rows = wp.zeros(shape=wp.static(per_lane), dtype=JointRows)
        acc = wp.zeros(shape=wp.static(per_lane), dtype=vector)
        residuals = wp.zeros(shape=wp.static(per_lane), dtype=Residuals)
        direction = wp.zeros(shape=wp.static(per_lane), dtype=Residuals)
        systems = wp.zeros(shape=wp.static(per_lane), dtype=BranchSystem)
        steps = wp.zeros(shape=wp.static(per_lane), dtype=vector)
        counts = wp.zeros(shape=wp.static(per_lane), dtype=int)
        contacts = wp.zeros(shape=wp.static(per_lane * points), dtype=Contact)
        x = wp.zeros(shape=wp.static(per_lane * points), dtype=vec4)
        dx = wp.zeros(shape=wp.static(per_lane * points), dtype=vec4)
        positions = wp.zeros(shape=wp.static(depth + 1), dtype=wp.vec3)
        rotations = wp.zeros(shape=wp.static(depth + 1), dtype=wp.mat33)
        ang_vels = wp.zeros(shape=wp.static(depth + 1), dtype=wp.vec3)
        lin_vels = wp.zeros(shape=wp.static(depth + 1), dtype=wp.vec3)

        trunk = make_trunk(robot, world, qpos, qvel)
        normal = floor_normal(robot, world)
        trunk_acc = TrunkMotion()
        trunk_acc.lin = wp.vec3(warmstart[world, 0], warmstart[world, 1], warmstart[world, 2])
        trunk_acc.ang = wp.vec3(warmstart[world, 3], warmstart[world, 4], warmstart[world, 5])
        mass = float(0.0)
        moment = wp.vec3(0.0)
        inertia = wp.mat33()
        force = wp.vec3(0.0)
        torque = wp.vec3(0.0)
        for i in range(wp.static(per_lane)):
            branch = lane + i * wp.static(lanes)
            if branch < wp.static(branches):
                legs[i] = make_branch(
                    robot, world, branch, trunk, qpos, qvel, ctrl, positions, rotations, ang_vels, lin_vels
                )
                rows[i] = make_joint_rows(robot, world, branch, qpos, qvel)
                counts[i] = find_contacts(
                    robot, world, branch, trunk.pos, normal, positions, rotations, ang_vels, lin_vels, contacts,
                    i * wp.static(points),
                )  # fmt: skip
                for j in range(wp.static(depth)):
                    acc[i][j] = warmstart[world, robot.branch_joint[branch, j] + 5]
                total = legs[i].total
                mass += total.mass
                moment += total.moment
                inertia += total.inertia
                force += total.force
                torque += total.torque
        trunk.mass += group_sum(mass, wp.static(lanes))
        trunk.moment += group_sum3(moment, wp.static(lanes))
        trunk.inertia += group_sum33_symmetric(inertia, wp.static(lanes))
        trunk.force += group_sum3(force, wp.static(lanes))
        trunk.torque += group_sum3(torque, wp.static(lanes))
        mass_coupling = trunk_mass_coupling(trunk)
        mass_rotation = trunk_mass_rotation(trunk)
        bias_ang = wp.transpose(trunk.rot) * trunk.torque
        for i in range(wp.static(per_lane)):
            residuals[i] = joint_rows_times(rows[i], acc[i])
            residuals[i].friction -= rows[i].friction_reference
            residuals[i].limit -= rows[i].limit_reference
            contact_rows_times(
                legs[i], trunk.rot, trunk_acc, acc[i], normal, contacts, i * wp.static(points), counts[i], x
            )
            for k in range(i * wp.static(points), i * wp.static(points) + counts[i]):
                x[k] = x[k] - contacts[k].reference

        used = int(0)
        for _iteration in range(iterations):
            used += 1
            system = TrunkSystem()
            for i in range(wp.static(per_lane)):
                if lane + i * wp.static(lanes) < wp.static(branches):
                    solved, add = eliminate(
                        legs[i], rows[i], residuals[i], trunk.rot, trunk_acc, acc[i], normal, contacts, x,
                        i * wp.static(points), counts[i],
                    )  # fmt: skip
                    systems[i] = solved
                    system.lin += add.lin
                    system.coupling += add.coupling
                    system.ang += add.ang
                    system.rhs_lin += add.rhs_lin
                    system.rhs_ang += add.rhs_ang
            own_lin = trunk.mass * trunk_acc.lin + mass_coupling * trunk_acc.ang + trunk.force
            own_ang = wp.transpose(mass_coupling) * trunk_acc.lin + mass_rotation * trunk_acc.ang + bias_ang
            system.lin = group_sum33_symmetric(system.lin, wp.static(lanes))
            system.lin += trunk.mass * wp.identity(n=3, dtype=float)
            system.coupling = group_sum33(system.coupling, wp.static(lanes)) + mass_coupling
            system.ang = group_sum33_symmetric(system.ang, wp.static(lanes)) + mass_rotation
            system.rhs_lin = group_sum3(system.rhs_lin, wp.static(lanes)) - own_lin
            system.rhs_ang = group_sum3(system.rhs_ang, wp.static(lanes)) - own_ang
            trunk_step = solve_trunk(system)

            slope = float(0.0)
            linear = float(0.0)
            quadratic = float(0.0)
            for i in range(wp.static(per_lane)):
                if lane + i * wp.static(lanes) < wp.static(branches):
                    steps[i] = branch_step(systems[i], trunk_step)
                    direction[i] = joint_rows_times(rows[i], steps[i])
                    contact_rows_times(
                        legs[i], trunk.rot, trunk_step, steps[i], normal, contacts, i * wp.static(points), counts[i], dx
                    )
                    part = wp.dot(steps[i], systems[i].gradient)
                    part += wp.dot(trunk_step.lin, systems[i].trunk_gradient_lin)
                    part += wp.dot(trunk_step.ang, systems[i].trunk_gradient_ang)
                    slope += part
                    at_start = row_slopes(
                        rows[i], residuals[i], direction[i], contacts, x, dx, i * wp.static(points), counts[i], 0.0
                    )
                    linear += part - at_start[0]
                    quadratic += wp.dot(steps[i], legs[i].mass * steps[i])
                    quadratic += 2.0 * wp.dot(legs[i].mass_lin * steps[i], trunk_step.lin)
                    quadratic += 2.0 * wp.dot(legs[i].mass_ang * steps[i], trunk_step.ang)
            own_slope = wp.dot(trunk_step.lin, own_lin) + wp.dot(trunk_step.ang, own_ang)
            slope = group_sum(slope, wp.static(lanes)) + own_slope
            linear = group_sum(linear, wp.static(lanes)) + own_slope
            quadratic = group_sum(quadratic, wp.static(lanes))
            quadratic += trunk.mass * wp.dot(trunk_step.lin, trunk_step.lin)
            quadratic += 2.0 * wp.dot(trunk_step.lin, mass_coupling * trunk_step.ang)
            quadratic += wp.dot(trunk_step.ang, mass_rotation * trunk_step.ang)
            if not (-slope * robot.cost_scale > 1.0e-9):
                break

            alpha = float(1.0)
            low = float(0.0)
            high = float(0.0)
            for _search in range(ls_iterations):
                slopes = wp.vec2(0.0, 0.0)
                for i in range(wp.static(per_lane)):
                    slopes += row_slopes(
                        rows[i], residuals[i], direction[i], contacts, x, dx, i * wp.static(points), counts[i], alpha
                    )
                first = linear + alpha * quadratic + group_sum(slopes[0], wp.static(lanes))
                second = quadratic + group_sum(slopes[1], wp.static(lanes))
                if wp.abs(first) <= -0.01 * slope:
                    break
                if first < 0.0:
                    low = alpha
                else:
                    high = alpha
                alpha -= first / second
                if high > 0.0 and (alpha <= low or alpha >= high):
                    alpha = 0.5 * (low + high)
            changed = float(0.0)
            trunk_acc.lin += alpha * trunk_step.lin
            trunk_acc.ang += alpha * trunk_step.ang
            for i in range(wp.static(per_lane)):
                acc[i] = acc[i] + alpha * steps[i]
                moved, flips = move_residuals(
                    rows[i], residuals[i], direction[i], x, dx, i * wp.static(points), counts[i], alpha
                )
                residuals[i] = moved
                changed += flips
            if alpha == 1.0 and group_sum(changed, wp.static(lanes)) == 0.0:
                break

        # integrate
        h = robot.timestep
        for i in range(wp.static(per_lane)):
            branch = lane + i * wp.static(lanes)
            if branch < wp.static(branches):
                for j in range(wp.static(depth)):
                    joint = robot.branch_joint[branch, j]
                    warmstart[world, joint + 5] = acc[i][j]
                    vel = qvel[world, joint + 5] + h * acc[i][j]
                    qvel[world, joint + 5] = vel
                    qpos[world, joint + 6] = qpos[world, joint + 6] + h * vel
                if sense:
                    for k in range(robot.point_count[branch]):
                        adr = robot.geom_sensor[robot.point_geom[branch, k]]
                        if adr >= 0:
                            for r in range(4):
                                sensordata[world, adr + r] = 0.0
                    for k in range(i * wp.static(points), i * wp.static(points) + counts[i]):
                        adr = contacts[k].sensor
                        if adr >= 0:
                            push = contact_force(contacts[k], normal, x[k])
                            sensordata[world, adr] = sensordata[world, adr] + 1.0
                            for r in range(3):
                                sensordata[world, adr + 1 + r] = sensordata[world, adr + 1 + r] + push[r]
        if lane == 0:
            lin = trunk.lin_vel + h * trunk_acc.lin
            ang = wp.transpose(trunk.rot) * trunk.ang_vel + h * trunk_acc.ang
            speed = wp.length(ang)
            quat = trunk.quat
            if speed > 0.0:
                quat = wp.normalize(quat_multiply(quat, quat_rotation(ang / speed, h * speed)))
            for r in range(3):
                warmstart[world, r] = trunk_acc.lin[r]
                warmstart[world, 3 + r] = trunk_acc.ang[r]
                qvel[world, r] = lin[r]
                qvel[world, 3 + r] = ang[r]
                qpos[world, r] = qpos[world, r] + h * lin[r]
            for r in range(4):
                qpos[world, 3 + r] = quat[r]
            niter[world] = used

    return fused_step
