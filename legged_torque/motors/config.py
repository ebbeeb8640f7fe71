"""Settings of motors: one section of ``motors`` per link of the chain. They need no torch."""

import pkgutil
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from legged_torque.utils.config import Section
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.limits import Limits, NotNegative, Share


class MotorCfg(Section):
    """Settings of a link. Inherit for a model of your own, and override :meth:`build`."""

    _motor_class = ""  # "module:Class", imported when it is built
    _of_law = False  # whether the link belongs to the control law, so that it stays with other motors

    def build(self, joints: Any) -> Any:
        """Return the :class:`~legged_torque.motors.motor.Motor` of :class:`~legged_torque.motors.motor.Joints`."""
        if not self._motor_class:
            raise UserError(f"{type(self).__name__} has no build")
        return pkgutil.resolve_name(self._motor_class)(self, joints)

    def describe(self) -> dict[str, Any]:
        """Return model and constants for ``policy.yaml``; no model if there is no numpy function for it."""
        return {}


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

    def seconds(self, path: str, dt: float, decimation: int) -> float:
        """Return the time [s] by which packets are late; arguments as of :meth:`counted`, a UserError if it varies."""
        (low, high), jitter, per_unit = self.counted(path, dt, decimation)
        if low != high or jitter or self.loss:
            raise UserError(f"{path} is not the same for all packets: --latency gives one time")
        return low * per_unit * dt

    def described(self) -> dict[str, Any]:
        """Return these settings for ``policy.yaml``."""
        return {"range": list(self.range), "unit": self.unit, "jitter": self.jitter, "loss": self.loss}


class DelayCfg(LatencyCfg, MotorCfg):
    """Settings of :class:`~legged_torque.motors.delay.ActionDelay`, which holds actions back."""

    _motor_class = "legged_torque.motors.delay:ActionDelay"


class PerturbationCfg(MotorCfg):
    """Settings of :class:`~legged_torque.motors.perturbation.TorquePerturbation`, which perturbs torques."""

    _motor_class = "legged_torque.motors.perturbation:TorquePerturbation"
    most: NotNegative = 2.0  # [N m]
    offset: NotNegative = 1.0
    of_pos: NotNegative = 1.0  # [1/rad]
    of_vel: NotNegative = 0.1  # [s/rad]


def check_single(where: str, kind: str, names: Sequence[str]) -> None:
    """Raise a UserError if there are several links of a kind."""
    if len(names) > 1:
        raise UserError(f"{where} must have one {kind} at most, not {', '.join(names)}")


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
