"""What needs a look at every physics step: power of the motors, and peaks of contact forces."""

from collections.abc import Callable, Sequence

import torch

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.state import RobotState
from legged_torque.motors.chain import MotorChain
from legged_torque.motors.config import by_joint


class StepMeter:
    """Measures each physics step; a sample after the last one of a control step can be far from mean and peak.

    In a physics step a torque is constant, and MuJoCo turns the joint by its new velocity times the step: the work is
    torque times new velocity times the step. Braking counts as driving, since nothing says that a battery takes it.
    Torques are those of the motors: what friction in a model of motors takes from them has been paid for, too.

    Attributes:
        is_on: Whether steps are measured; trainings do without. See :meth:`BaseTask.measure_steps`.
        mechanical: Sum over joints of |torque times velocity| [W]; NaN before the first step. Shape: (num_envs,).
        torque_change: Sum over an episode's physics steps of the mean over joints of |change of torque| [N m]. Shape:
            (num_envs,).
        copper: Heat in the windings, sum over joints of copper_loss times squared torque [W]. Shape: (num_envs,).
        peak_force: Largest sum over geoms of the norm of the contact force, in any physics step of the episode [N].
            Shape: (num_envs,).
        copper_loss: Heat per squared torque of each joint [W/(N m)^2]. Shape: (num_dof,).
        has_losses: Whether any joint has copper losses.
    """

    is_on = False

    def __init__(
        self, state: RobotState, motors: MotorChain, control: type[LeggedRobotCfg.control], dof_names: Sequence[str]
    ) -> None:
        """Take decimation and losses of the section ``control``; errors of :func:`by_joint`."""
        self._state, self._motors, self._share = state, motors, 1.0 / control.decimation
        losses = by_joint("control.copper_loss", control.copper_loss, dof_names)
        self.copper_loss, self.has_losses = torch.tensor(losses, device=state.device), any(losses)
        self.mechanical = torch.full((state.num_envs,), torch.nan, device=state.device)
        self.copper, self.torque_change, self.peak_force = torch.zeros(3, state.num_envs, device=state.device).unbind()
        self._last_torques, self._has_last = torch.zeros_like(state.torques), torch.zeros_like(state.reset_buf)

    def begin(self) -> list[Callable[[], None]]:
        """Begin a control step; return what to call after each physics step, if it is measured."""
        if not self.is_on:
            return []
        self.mechanical.zero_()
        self.copper.zero_()
        self.torque_change.zero_()
        self.peak_force.masked_fill_(self._state.reset_buf, 0.0)
        torch.logical_not(self._state.reset_buf, out=self._has_last)
        self._last_torques.copy_(self._motors.before_friction(self._state.torques))
        return [self._add_step]

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return what is kept from control step to control step."""
        return {"peak_force": self.peak_force}

    def _add_step(self) -> None:
        """Add the physics step that has just been made."""
        torques, vel = self._motors.before_friction(self._state.torques), self._state.dof_vel
        force = self._state.contact_force.norm(dim=2).sum(dim=1).nan_to_num(0.0, 0.0)  # of a world that diverges
        torch.maximum(self.peak_force, force, out=self.peak_force)
        change = (torques - self._last_torques).abs().mean(dim=1)
        self.torque_change.add_(torch.where(self._has_last, change, 0.0))
        self._last_torques.copy_(torques)
        self._has_last.fill_(True)
        self.mechanical.add_((torques * vel).abs().sum(dim=1), alpha=self._share)
        if self.has_losses:
            self.copper.add_(torques.square() @ self.copper_loss, alpha=self._share)
