"""The metrics of walking (paper, IV-A): names, units, formulas. Needs no torch; formulas take numpy arrays or tensors.

Every metric is a ratio of two sums over steps. Velocities are those of the trunk in its own frame. Steps after which a
world was reset are left out, but for the count of falls.

- track_percentage: mean of max(0, mean over the commands that are not 0 of 1 - |v - v*| / |v*|); 1 is perfect. A yaw
  rate that turns to a heading is not among them: it is nearly 0 where the heading is right.
- track_xy: mean of |v*_xy - v_xy|^2 [m^2/s^2]. track_angular: mean of (w*_z - w_z)^2 [rad^2/s^2].
- collision_force: mean of the sum over geoms of the norm of the ground's force, in the last physics step of a
  control step [N]. A robot that stands still has its weight, 122 N for the A1, and a little more where its feet
  push sideways: 127 N in the nominal pose.
- peak_force: mean over episodes that ended of the largest sum over geoms in any of their physics steps [N].
- mechanical_power: mean of sum |tau_i qd_i| over all physics steps [W], tau_i being what a motor makes before its own
  friction. cost_of_transport: this mean over m g times mean horizontal speed, with the nominal m g.
- electrical_power, electrical_cost: the same with copper losses, mean of sum |tau_i qd_i| + c_i tau_i^2 [W], if
  ``control.copper_loss`` gives c = R / (gear Kt)^2 [W/(N m)^2]: the current is tau / (gear Kt), and its heat I^2 R.
  No source gives R and Kt of Unitree's motors, so that a number for them is an assumption.
- torque_rate: mean over joints of the sum of |change of torque| between an episode's physics steps, per
  second [N m/s].
- height: mean height of the trunk's origin above the ground [m]. speed: mean horizontal speed [m/s].
- falls_per_minute: resets that are not time-outs, per minute of one robot.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

Array: TypeAlias = Any  # a numpy array or a torch tensor

UNITS = {
    "track_percentage": "share",
    "track_xy": "m^2/s^2",
    "track_angular": "rad^2/s^2",
    "collision_force": "N",
    "peak_force": "N",
    "cost_of_transport": "",
    "mechanical_power": "W",
    "electrical_power": "W",
    "electrical_cost": "",
    "torque_rate": "N m/s",
    "height": "m",
    "speed": "m/s",
    "falls_per_minute": "1/min",
}
"""Units of the metrics, by their names in files and on the terminal; each has its formula in :func:`ratios`."""
NUM_SUMS = 14  # numbers that step_sums returns for each world


@dataclass
class Estimate:
    """A mean over worlds and steps, NaN where nothing was measured; its standard error is NaN with one world."""

    mean: float
    standard_error: float


def hide_nan(line: str) -> str:
    """Return a line of results with - for what was not measured, and without standard errors of a single world."""
    line = line.replace("nan +- nan", f"{'-':>12}")  # means are wider than NaN by two
    return line.replace(" +- nan", "").replace(" nan", "   -")


def tracking_percentage(xp: ModuleType, error: Array, commands: Array) -> tuple[Array, Array]:
    """Return how much of its commands each world follows, and 1 where anything was commanded, else 0.

    ``xp`` is ``numpy`` or ``torch``. The error is |v - v*|; commands of exactly 0 do not count. Shapes: (worlds,
    commands).
    """
    counts = commands != 0.0
    relative = xp.where(counts, 1.0 - error / xp.where(counts, abs(commands), 1.0), 0.0)
    number = counts.sum(axis=1)
    return xp.clip(relative.sum(axis=1) / xp.clip(number, 1, None), 0.0, None), (number > 0) * 1.0


def step_sums(
    xp: ModuleType,
    commands: Array,
    velocity: Array,
    speed: Array,
    force: Array,
    power: Array,
    copper: Array,
    torque_change: Array,
    height: Array,
    fell: Array,
    ended: Array,
    peak_force: Array,
    *,
    tracked: int = 3,
) -> Array:
    """Return the contribution of one control step of each world to the sums.

    Args:
        xp: ``numpy`` or ``torch``, whichever the arrays are of.
        commands: Those that held during the step: v_x, v_y [m/s], yaw rate [rad/s]. Shape: (worlds, 3).
        velocity: Of the trunk in its own frame after the step: v_x, v_y [m/s], yaw rate [rad/s]. Shape: (worlds, 3).
        speed: Horizontal speed of the trunk [m/s]. Shape: (worlds,).
        force: Sum over geoms of the norm of the ground's force [N]. Shape: (worlds,).
        power: Sum over joints of |torque times velocity|, mean over physics steps [W]. Shape: (worlds,).
        copper: Heat in the windings, likewise [W]. Shape: (worlds,).
        torque_change: Sum over physics steps of the mean over joints of |change of torque| [N m]. Shape: (worlds,).
        height: Of the trunk's origin above the ground [m]. Shape: (worlds,).
        fell: Whether the episode ended with the step, but not by its time. Shape: (worlds,), bool.
        ended: Whether it ended at all; then nothing but the fall counts. Shape: (worlds,), bool.
        peak_force: Largest force in the episode [N]. Shape: (worlds,).
        tracked: How many of the commands count for the tracking percentage: 2 if the yaw rate turns to a heading.

    Returns:
        Shape: (:data:`NUM_SUMS`, worlds): steps, tracking percentage, steps with a command, xy, angular, force, power,
        copper, change of torque, height, speed, falls, episodes that ended, their peaks of force.
    """
    error = abs(commands - velocity)
    percentage, is_commanded = tracking_percentage(xp, error[:, :tracked], commands[:, :tracked])
    one, zero = xp.ones_like(percentage), xp.zeros_like(percentage)
    xy, angular = (error[:, :2] ** 2).sum(axis=1), error[:, 2] ** 2
    moved = [power, copper, torque_change, height, speed]
    rows = xp.stack([one, percentage, is_commanded, xy, angular, force, *moved, zero, zero, zero])
    rows = xp.where(ended, 0.0, rows)
    rows[-3], rows[-2], rows[-1] = fell, ended, xp.where(ended, peak_force, 0.0)
    return rows


def ratios(sums: Array, weight: float, control_step: float, has_losses: bool) -> dict[str, tuple[Array, Array]]:
    """Return numerator and denominator of each metric, per world. Shapes: (worlds,).

    ``sums`` are those of :func:`step_sums`, ``weight`` is the robot's m g [N], and ``control_step`` is in seconds. A
    robot that ``has_losses`` has metrics of electrical power, too.
    """
    steps, percentage, commanded, xy, angular, force, power, copper, change, height, speed, falls, ends, peaks = sums
    electrical = {"electrical_power": (power + copper, steps), "electrical_cost": (power + copper, weight * speed)}
    return {
        "track_percentage": (percentage, commanded),
        "track_xy": (xy, steps),
        "track_angular": (angular, steps),
        "collision_force": (force, steps),
        "peak_force": (peaks, ends),
        "cost_of_transport": (power, weight * speed),
        "mechanical_power": (power, steps),
        **(electrical if has_losses else {}),
        "torque_rate": (change, steps * control_step),
        "height": (height, steps),
        "speed": (speed, steps),
        "falls_per_minute": (falls, steps * (control_step / 60.0)),
    }


def estimates(of: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, Estimate]:
    """Return metrics with standard errors, from their :func:`ratios`."""
    return {name: estimate(*parts) for name, parts in of.items()}


def estimate(numerator: np.ndarray, denominator: np.ndarray) -> Estimate:
    """Return a ratio of sums over worlds with its standard error, which takes worlds as independent (delta method)."""
    total, count = denominator.sum(), np.count_nonzero(np.logical_or(numerator, denominator))  # of those that took part
    if total == 0.0:
        return Estimate(math.nan, math.nan)
    mean = numerator.sum() / total
    if count == 1:
        return Estimate(float(mean), math.nan)
    variance = np.square(numerator - mean * denominator).sum() * count / (count - 1)
    return Estimate(float(mean), float(np.sqrt(variance) / total))
