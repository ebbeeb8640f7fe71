"""Variable stiffness: the policy sends PD targets and how stiff to hold them (Spoljaric et al., arXiv 2502.09436)."""

import dataclasses

import torch
from torch import Tensor

from legged_torque.envs.approaches.variable_stiffness_config import VariableStiffnessCfg as VariableStiffnessCfg
from legged_torque.envs.approaches.variable_stiffness_config import VariableStiffnessCfgPPO as VariableStiffnessCfgPPO
from legged_torque.envs.base.actions import ActionTerm
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.observations import ObservationTerm
from legged_torque.motors.model_config import NetworkCfg
from legged_torque.utils.errors import UserError
from legged_torque.utils.mirroring import Mirroring


class VariableStiffnessRobot(LeggedRobot):
    """A robot with two actions per joint: a position residual, then a change of its stiffness.

    A leg has the mean of the stiffness actions of its joints. Torques leave the physics kernel, whose laws see one
    action of a joint.
    """

    cfg: VariableStiffnessCfg

    def _init_buffers(self) -> None:
        """Prepare the means over legs; a joint of no leg is alone."""
        super()._init_buffers()
        legs = [leg for pair in self.cfg.asset.mirrored_legs for leg in pair]
        own = [next((leg for leg in legs if name.startswith(leg)), name) for name in self.dof_names]
        own = own if self.cfg.control.stiffness_of == "leg" else self.dof_names
        is_same = torch.tensor([[a == b for b in own] for a in own], dtype=torch.float32, device=self.device)
        self._means = is_same / is_same.sum(dim=0)

    def action_terms(self) -> list[ActionTerm]:
        """Return a position residual and a change of the stiffness per joint; a UserError if a motor is a network."""
        motors = self.cfg.motors
        if any(isinstance(getattr(motors, name, None), NetworkCfg) for name in motors.chain):
            raise UserError("motors.chain: a network is of a drive with fixed gains, which this task's policy changes")
        scale, meaning = self.control.action_scale, "joint position relative to nominal_pose, for PD control"
        stiffness = torch.full_like(scale, self.cfg.control.stiffness_scale)
        return [
            ActionTerm("position_of_stiffness", scale, "rad", meaning),
            ActionTerm("stiffness", stiffness, "N m/rad", "added to the joint's stiffness", is_unsigned=True),
        ]

    def _compute_torques(self, actions: Tensor) -> Tensor:
        """tau = Kp (q_nominal + scale a - q) - Kd qd [N m], Kd = 0.2 sqrt(Kp). Shape: (num_envs, num_dof)."""
        targets, changes = actions.split(self.num_dof, dim=1)
        settings, control = self.cfg.control, self.control
        p_gains = self.p_gains + settings.stiffness_scale * changes @ self._means
        p_gains = p_gains.clamp(*settings.stiffness_range)
        targets = self.default_dof_pos + control.joint_offset + control.action_scale * targets
        pos, vel = self.motors.measured(self.dof_pos, self.dof_vel)
        return p_gains * (targets - pos) - self.d_gains * p_gains.sqrt() * vel

    def observation_terms(self) -> list[ObservationTerm]:
        """Return the usual ones; in a mirror image, stiffness actions keep their signs."""
        joints, terms = self.symmetry.joints, super().observation_terms()
        mirror = joints and Mirroring.joined([joints, joints.unsigned()])
        return [dataclasses.replace(term, mirror=mirror) if term.name == "last_action" else term for term in terms]
