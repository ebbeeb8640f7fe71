"""Settings of motors: one section of ``motors`` per link of the chain. They need no torch."""

from __future__ import annotations

import pkgutil
from typing import Annotated, Any, Literal

from legged_torque.utils.config import Section
from legged_torque.utils.limits import Limits, NotNegative


class MotorCfg(Section):
    """Settings of a link. Inherit for a model of your own, and override :meth:`build`."""

    _motor_class = ""  # "module:Class", imported when it is built

    def build(self, joints: Any) -> Any:
        """Return the :class:`~legged_torque.motors.motor.Motor` of :class:`~legged_torque.motors.joints.Joints`."""
        return pkgutil.resolve_name(self._motor_class)(self, joints)


class DelayCfg(MotorCfg):
    """Settings of :class:`~legged_torque.motors.delay.ActionDelay`, which holds actions back."""

    _motor_class = "legged_torque.motors.delay:ActionDelay"
    range: Annotated[list[int], Limits(0, 1000, ordered=True)] = [0, 0]  # in ``unit``, drawn at every reset
    unit: Literal["physics_steps", "control_steps"] = "physics_steps"  # or "control_steps"


class IdealCfg(MotorCfg):
    """Settings of :class:`~legged_torque.motors.ideal.IdealMotor`: any torque within the limits, at once."""

    _motor_class = "legged_torque.motors.ideal:IdealMotor"


class PerturbationCfg(MotorCfg):
    """Settings of :class:`~legged_torque.motors.perturbation.TorquePerturbation`, which perturbs torques."""

    _motor_class = "legged_torque.motors.perturbation:TorquePerturbation"
    most: NotNegative = 2.0  # [N m]
    offset: NotNegative = 1.0
    of_pos: NotNegative = 1.0  # [1/rad]
    of_vel: NotNegative = 0.1  # [s/rad]
