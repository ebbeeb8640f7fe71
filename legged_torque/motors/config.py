"""Settings of motors: one section of ``motors`` per link of the chain. They need no torch."""

from __future__ import annotations

import pkgutil
from typing import Annotated, Any, Literal

from legged_torque.utils.config import Section
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import Limits, Share


class MotorCfg(Section):
    """Settings of a link. Inherit for a model of your own, and override :meth:`build`."""

    _motor_class = ""  # "module:Class", imported when it is built

    def build(self, joints: Any) -> Any:
        """Return the :class:`~legged_torque.motors.motor.Motor` of :class:`~legged_torque.motors.joints.Joints`."""
        return pkgutil.resolve_name(self._motor_class)(self, joints)


class LatencyCfg(Section):
    """Settings of packets that are late: a constant time per world, and what each packet adds to it."""

    range: Annotated[list[int], Limits(0, 1000, ordered=True)] = [0, 0]  # in ``unit``, drawn at every reset
    unit: Literal["physics_steps", "control_steps", "milliseconds"] = "physics_steps"  # of range and jitter
    jitter: Annotated[int, Limits(0, 1000)] = 0  # in ``unit``, up to which each packet is later, drawn for each
    loss: Share = 0.0  # share of packets that are lost: what has arrived before is held

    def counted(self, path: str, dt: float, decimation: int) -> tuple[tuple[int, int], int, int]:
        """Return range and jitter in units that are whole physics steps, and how many steps such a unit has.

        Args:
            path: Of these settings, for the UserError if milliseconds are not a whole number of physics steps.
            dt: Physics step [s].
            decimation: Physics steps per control step.
        """
        per_unit = 1e-3 / dt if self.unit == "milliseconds" else 1.0
        counts = []
        for name, value in [("range", self.range[0]), ("range", self.range[1]), ("jitter", self.jitter)]:
            counts.append(round(value * per_unit))
            if abs(value * per_unit - counts[-1]) > 1e-6 * max(counts[-1], 1):
                whole = f"a whole number of physics steps of {1e3 * dt:g} ms"
                raise UserError(f"{path}.{name} must be {whole} (sim.dt), not {value} milliseconds")
        return (counts[0], counts[1]), counts[2], decimation if self.unit == "control_steps" else 1

    def described(self) -> dict[str, Any]:
        """Return these settings for ``policy.yaml``."""
        return {"range": list(self.range), "unit": self.unit, "jitter": self.jitter, "loss": self.loss}


class DelayCfg(LatencyCfg, MotorCfg):
    """Settings of :class:`~legged_torque.motors.delay.ActionDelay`, which holds actions back."""

    _motor_class = "legged_torque.motors.delay:ActionDelay"


class IdealCfg(MotorCfg):
    """Settings of :class:`~legged_torque.motors.ideal.IdealMotor`: any torque within the limits, at once."""

    _motor_class = "legged_torque.motors.ideal:IdealMotor"
