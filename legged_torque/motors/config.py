"""Settings of motors: one section of ``motors`` per link of the chain. They need no torch."""

from __future__ import annotations

import pkgutil
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from legged_torque.utils.config import Section
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.limits import Limits


class MotorCfg(Section):
    """Settings of a link. Inherit for a model of your own, and override :meth:`build`."""

    _motor_class = ""  # "module:Class", imported when it is built

    def build(self, joints: Any) -> Any:
        """Return the :class:`~legged_torque.motors.motor.Motor` of :class:`~legged_torque.motors.joints.Joints`."""
        return pkgutil.resolve_name(self._motor_class)(self, joints)

    def describe(self) -> dict[str, Any]:
        """Return model and constants for ``policy.yaml``; no model if there is no numpy function for it."""
        return {}


class DelayCfg(MotorCfg):
    """Settings of :class:`~legged_torque.motors.delay.ActionDelay`, which holds actions back."""

    _motor_class = "legged_torque.motors.delay:ActionDelay"
    range: Annotated[list[int], Limits(0, 1000, ordered=True)] = [0, 0]  # in ``unit``, drawn at every reset
    unit: Literal["physics_steps", "control_steps"] = "physics_steps"  # or "control_steps"


class IdealCfg(MotorCfg):
    """Settings of :class:`~legged_torque.motors.ideal.IdealMotor`: any torque within the limits, at once."""

    _motor_class = "legged_torque.motors.ideal:IdealMotor"

    def describe(self) -> dict[str, Any]:
        """Return the name of the model; ``policy.yaml`` has its limits anyway."""
        return {"model": "ideal"}


def by_joint(setting: str, values: float | dict[str, float], dof_names: Sequence[str]) -> list[float]:
    """Return a number for each joint: one for all, or by a part of their names, of which the first match counts.

    A UserError, which names the setting, if a joint has no number or a name matches no joint.
    """
    if not isinstance(values, dict):
        return [values] * len(dof_names)
    for part in values:
        if not any(part in name for name in dof_names):
            raise unknown_name(f"joint (part of its name) in {setting}", part, dof_names)
    taken = []
    for name in dof_names:
        matching = [part for part in values if part in name]
        if not matching:
            raise UserError(f"{setting} lacks the joint '{name}'; it has {', '.join(values) or 'no entries'}")
        taken.append(matching[0])
    for part in values:
        if part not in taken:
            raise UserError(f"'{part}' in {setting} has no effect: its joints take a name before it")
    return [values[part] for part in taken]
