"""Variable stiffness: the policy sends PD targets and how stiff to hold them (Spoljaric et al., arXiv 2502.09436)."""

import dataclasses

import torch
import warp as wp

from legged_torque.envs.approaches.variable_stiffness_config import VariableStiffnessCfg as VariableStiffnessCfg
from legged_torque.envs.base.actions import ActionTerm, PdControl, pd_target, position_residual
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.motors.kernel import read
from legged_torque.motors.model_config import NetworkCfg
from legged_torque.utils.errors import UserError


@wp.struct
class StiffnessControl:
    """Inputs of :func:`stiff_torque`."""

    pd: PdControl
    changes: wp.array2d[float]  # of the stiffness of a joint (column) per stiffness action (row) [N m/rad]
    lowest: float  # [N m/rad]
    highest: float


@wp.func
def stiff_torque(
    control: StiffnessControl, actions: wp.array[float], world: int, joint: int, pos: float, vel: float
) -> float:
    """tau = Kp (q_nominal + scale a - q) - Kd qd [N m], Kd = 0.2 sqrt(Kp)."""
    pd, num_dof = control.pd, control.changes.shape[0]  # type: ignore[attr-defined]
    p_gain = pd.p_gains[world, joint]
    for i in range(num_dof):
        p_gain += control.changes[i, joint] * actions[num_dof + i]
    p_gain = wp.clamp(p_gain, control.lowest, control.highest)
    error = pd_target(pd, actions[joint], world, joint) - pos
    return p_gain * error - pd.d_gains[world, joint] * wp.sqrt(p_gain) * vel


class VariableStiffnessRobot(LeggedRobot):
    """A robot with two actions per joint: a position residual, then a change of its stiffness.

    A leg has the mean of the stiffness actions of its joints; a joint of no leg is alone.
    """

    cfg: VariableStiffnessCfg

    def action_terms(self) -> list[ActionTerm]:
        """Return a position residual and a change of the stiffness per joint; a UserError if a motor is a network."""
        motors = self.cfg.motors
        if any(isinstance(getattr(motors, name, None), NetworkCfg) for name in motors.chain):
            raise UserError("motors.chain: a network is of a drive with fixed gains, which this task's policy changes")
        settings, positions = self.cfg.control, position_residual(self.control)
        legs = [leg for pair in self.cfg.asset.mirrored_legs for leg in pair]
        own = [next((leg for leg in legs if name.startswith(leg)), name) for name in self.dof_names]
        own = own if settings.stiffness_of == "leg" else self.dof_names
        is_same = torch.tensor([[a == b for b in own] for a in own], dtype=torch.float32, device=self.device)
        changes = settings.stiffness_scale * is_same / is_same.sum(dim=0)
        low, high = settings.stiffness_range
        reads = read(StiffnessControl, pd=positions.reads, changes=changes, lowest=low, highest=high)
        scale, meaning = torch.full_like(positions.scale, settings.stiffness_scale), "added to the joint's stiffness"
        return [
            dataclasses.replace(positions, name="position_of_stiffness", law=None, whole_law=stiff_torque, reads=reads),
            ActionTerm("stiffness", scale, "N m/rad", meaning, is_unsigned=True),
        ]
