"""The whole-body controller that stands: task, posture and reaction force control in one (eq. 3)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from legged_torque.paper.gravity import operational_space as osc
from legged_torque.paper.gravity.contact_forces import ForceDistribution, ForceLimits
from legged_torque.paper.gravity.dynamics import TRUNK_DOFS, RobotDynamics, single_threaded
from legged_torque.utils.errors import UserError


@dataclass(frozen=True)
class WholeBodySettings:
    """Gains and limits of the controller; the defaults are for the A1 at 200 Hz."""

    height: float = 0.303  # [m] of the trunk's origin above the ground
    position_stiffness: float = 30.0  # [1/s^2] of the trunk towards its height and the middle of its feet
    position_damping: float = 10.0  # [1/s] of its linear velocity
    attitude_stiffness: float = 300.0  # [1/s^2] of the trunk towards level
    attitude_damping: float = 30.0  # [1/s] of its angular velocity, yaw included
    joint_stiffness: float = 20.0  # [N m/rad] of the posture towards the nominal pose
    joint_damping: float = 1.0  # [N m s/rad] of the posture
    support_height: float = 0.02  # [m] above the ground at which a foot in the air counts half as a support
    foot_stiffness: float = 200.0  # [N/m] of feet in the air towards where they can catch the trunk
    capture_time: float = 0.2  # [s] by which such feet are ahead of the trunk; about sqrt(height / 9.81)
    friction: float = 0.8  # of the friction pyramids; the simulated ground has 1
    lowest_force: float = 3.0  # [N] normal force of a contact
    highest_force: float = 200.0  # [N] normal force of a contact; the robot weighs 122 N
    arm: float = 0.2  # [m] from the trunk to its feet, which makes moments comparable with forces
    force_regularization: float = 1e-3  # of single contact forces against the wrench on the trunk
    task_damping: float = 1e-3  # of task torques where the contacts can hardly serve the task


@dataclass
class WholeBodyTorques:
    """Output of the controller: torques [N m]; forces of the ground on the robot, in the world frame [N]."""

    task: Tensor  # Gamma_task (eq. 4). Shape: (n, joints)
    posture: Tensor  # Gamma_posture (eq. 5). Shape: (n, joints)
    force: Tensor  # Gamma_force (eq. 6). Shape: (n, joints)
    total: Tensor  # Gamma (eq. 3), clipped to the torque limits. Shape: (n, joints)
    contact_forces: Tensor  # f_csd (eq. 10), zero where nothing touches. Shape: (n, k, 3)
    wrench_residual: Tensor  # wrench on the trunk, given less needed; moment in its own frame. Shape: (n, 6)


class WholeBodyController:
    """Keeps the trunk level at its height above the middle of its feet, whichever of them touch the ground.

    - Task (eq. 4): the six degrees of freedom of the trunk. f* is a spring and damper on height, attitude and the
      horizontal distance of the centre of mass from the middle of the feet; yaw is only damped. Feet in the air count
      less the higher they are. F holds the contact-consistent gravity p, so that at f* = 0 this is gravity
      compensation. Only legs on the ground serve the task, with the least torques that exert F on the trunk.
    - Posture (eq. 5): Gamma_0 is a PD control of all joints towards the nominal pose, plus springs that draw feet in
      the air under the hips of the level trunk, and ahead of its velocity, to catch it. The null space removes the
      part that would disturb the trunk: nothing for legs in the air, all but internal forces for the others.
    - Force (eq. 6): both together would cause the contact forces of eq. 11. Where these leave the friction pyramids or
      limits, or where the legs on the ground cannot exert F, f_csd are the allowed forces nearest to the wrench that
      the trunk needs (eq. 10), and -J_c^T (f_csd - f_c) makes the joints press with these instead.

    Without any contact, task and force torques are zero and the PD control remains.
    """

    def __init__(
        self, dynamics: RobotDynamics, nominal_pose: Sequence[float], settings: WholeBodySettings | None = None
    ) -> None:
        """Prepare the constants. Every call of the controller updates ``dynamics``; ``nominal_pose`` is in rad.

        Raises:
            UserError: If the pose has another number of joints, a joint lacks a motor with force limits, or no contact
                force is inside the limits of the settings.
        """
        self.settings = settings = settings or WholeBodySettings()
        self.dynamics = dynamics
        model, device = dynamics.mj_model, dynamics.device
        joints = model.nv - TRUNK_DOFS
        if len(nominal_pose) != joints:
            raise UserError(f"the nominal pose has {len(nominal_pose)} joints, the robot {joints}")
        driven = model.actuator_trnid[:, 0].tolist()
        if driven != list(range(1, model.njnt)) or not (model.actuator_forcelimited == 1).all():
            raise UserError("whole-body control needs one motor with a force range per joint, in the joints' order")
        self._pose = torch.tensor(nominal_pose, dtype=torch.float32, device=device)
        ranges = model.actuator_forcerange.T.copy()
        self._lowest, self._highest = torch.tensor(ranges, dtype=torch.float32, device=device)
        limits = ForceLimits(settings.friction, settings.lowest_force, settings.highest_force)
        self._distribute = ForceDistribution(limits, settings.arm, settings.force_regularization, device)
        qpos = torch.zeros(dynamics.num_states, model.nq, device=device)
        qpos[:, 3] = 1.0
        qpos[:, TRUNK_DOFS + 1 :] = self._pose
        dynamics.update(qpos, torch.zeros(dynamics.num_states, model.nv, device=device))
        self._nominal_feet = dynamics.contact_points[0].clone()  # seen from the trunk [m]. Shape: (k, 3)

    @single_threaded()
    def __call__(self, qpos: Tensor, qvel: Tensor, mask: Tensor) -> WholeBodyTorques:
        """Compute the torques for many states at once, on level ground at z = 0.

        ``qpos`` and ``qvel`` are as in :meth:`RobotDynamics.update`; ``mask`` (n, k), bool, has the contacts that touch
        the ground.
        """
        robot = self.dynamics
        robot.update(qpos, qvel)
        bias = robot.coriolis + robot.gravity
        contacts = osc.contact_space(robot.inertia, robot.contact_jacobians, robot.contact_bias, mask)
        task = osc.task_space(contacts, robot.trunk_jacobian, robot.coriolis, robot.gravity)
        serving = (mask.unsqueeze(2) & robot.contact_joints).any(dim=1)
        to_torques = osc.torque_map(task, serving, self.settings.task_damping)
        wanted = osc.task_force(task, self._trunk_acceleration(qvel, mask))
        task_torques = osc.apply(to_torques, wanted)
        posture = osc.posture_torques(task, to_torques, self._posture(qpos, qvel, mask))
        caused = osc.contact_forces(contacts, task_torques + posture, bias)

        # The wrench that the trunk needs: F, and the contact forces if F came from outside. With enough contacts this
        # is what the caused forces give; with too few, F is more than joints can exert.
        on_trunk = osc.apply(robot.trunk_jacobian.mT, wanted)
        passive = osc.contact_forces(contacts, posture, bias - on_trunk).flatten(1)
        grasp, to_joints = contacts.jacobian.mT.split([TRUNK_DOFS, contacts.jacobian.shape[2] - TRUNK_DOFS], dim=1)
        needed = on_trunk[:, :TRUNK_DOFS] + osc.apply(grasp, passive)

        forces, residual = self._distribute(grasp, needed, caused, mask)
        force = -osc.apply(to_joints, (forces - caused).flatten(1))
        total = (task_torques + posture + force).clamp(self._lowest, self._highest)
        return WholeBodyTorques(task_torques, posture, force, total, forces, residual)

    def _trunk_acceleration(self, qvel: Tensor, mask: Tensor) -> Tensor:
        """Return f* of eq. 4 in the world frame [m/s^2, rad/s^2]. Shape: (n, 6)."""
        robot, settings = self.dynamics, self.settings
        height = robot.contact_points[:, :, 2].clamp(min=0.0)
        weights = torch.where(mask, 1.0, settings.support_height / (settings.support_height + height))
        weights = weights / weights.sum(dim=1, keepdim=True)
        error = (weights.unsqueeze(1) @ robot.contact_points).squeeze(1) - robot.com
        error[:, 2] = settings.height - robot.trunk_position[:, 2]
        velocity = osc.apply(robot.trunk_jacobian, qvel)
        linear = settings.position_stiffness * error - settings.position_damping * velocity[:, :3]
        up = robot.trunk_rotation[:, :, 2]
        to_level = torch.stack([up[:, 1], -up[:, 0], torch.zeros_like(up[:, 0])], dim=1)  # up x vertical
        angular = settings.attitude_stiffness * to_level - settings.attitude_damping * velocity[:, 3:]
        return torch.cat([linear, angular], dim=1)

    def _posture(self, qpos: Tensor, qvel: Tensor, mask: Tensor) -> Tensor:
        """Return Gamma_0 of eq. 5 [N m]. Shape: (n, joints)."""
        robot, settings = self.dynamics, self.settings
        spring = settings.joint_stiffness * (self._pose - qpos[:, TRUNK_DOFS + 1 :])
        catching = settings.foot_stiffness * (self._catching_feet(qvel) - robot.contact_points)
        catching = torch.where(mask.unsqueeze(2), 0.0, catching).flatten(1)
        jacobian = robot.contact_jacobians[..., TRUNK_DOFS:].flatten(1, 2)
        return spring - settings.joint_damping * qvel[:, TRUNK_DOFS:] + osc.apply(jacobian.mT, catching)

    def _catching_feet(self, qvel: Tensor) -> Tensor:
        """Return where feet would catch a level trunk, ahead of its velocity, in the world [m]. Shape: (n, k, 3)."""
        robot = self.dynamics
        forward = robot.trunk_rotation[:, :2, 0]
        cos, sin = (forward / torch.linalg.vector_norm(forward, dim=1, keepdim=True).clamp(min=1e-3)).split(1, dim=1)
        x, y, z = self._nominal_feet.unbind(dim=1)
        feet = torch.stack([cos * x - sin * y, sin * x + cos * y, z.expand(len(cos), -1)], dim=2)
        feet = feet + robot.trunk_position.unsqueeze(1)
        feet[:, :, :2] += self.settings.capture_time * qvel[:, None, :2]
        return feet
