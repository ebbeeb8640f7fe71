"""The metrics of :mod:`legged_torque.envs.base.metrics` in numpy, for robots that run one after another."""

from __future__ import annotations

import numpy as np

UNITS = {
    "track_percentage": "",
    "track_xy": "m^2/s^2",
    "track_angular": "rad^2/s^2",
    "collision_force": "N",
    "cost_of_transport": "",
    "height": "m",
    "speed": "m/s",
    "falls_per_minute": "1/min",
}
"""The metrics, the paper's five first, and their units."""


def step_sums(
    command: np.ndarray, velocity: np.ndarray, force: float, power: float, height: float, fell: bool, ended: bool
) -> np.ndarray:
    """Return what one control step of one robot adds to the sums.

    Args:
        command: That held during the step: v_x, v_y [m/s], yaw rate [rad/s]. Shape: (3,).
        velocity: Of the trunk in its own frame after the step, likewise. Shape: (3,).
        force: Sum over geoms of the norm of the ground's force [N].
        power: Sum over joints of |torque times velocity| [W].
        height: Of the trunk's origin [m].
        fell: Whether the episode ended with the step, but not by its time.
        ended: Whether it ended at all; then nothing but the fall counts.

    Returns:
        Shape: (10,): steps, tracking percentage, steps with a command, xy, angular, force, power, height, speed, falls.
    """
    if ended:
        return np.array([0.0] * 9 + [float(fell)])
    error = np.abs(command - velocity)
    counts = command != 0.0
    relative = 1.0 - error[counts] / np.abs(command[counts])
    percentage = max(0.0, relative.mean()) if counts.any() else 0.0
    speed = np.linalg.norm(velocity[:2])
    xy = np.square(error[:2]).sum()
    return np.array([1.0, percentage, float(counts.any()), xy, error[2] ** 2, force, power, height, speed, 0.0])


def estimates(sums: np.ndarray, weight: float, control_step: float) -> dict[str, dict[str, float]]:
    """Return the metrics with standard errors, which take robots as independent.

    Args:
        sums: Of :func:`step_sums`, per robot. Shape: (robots, 10).
        weight: Of the robot, m g [N].
        control_step: [s].

    Returns:
        "mean" and "standard_error" of each metric; NaN where nothing was measured, and the error with one robot.
    """
    steps, percentage, commanded, xy, angular, force, power, height, speed, falls = sums.T
    ratios = {
        "track_percentage": (percentage, commanded),
        "track_xy": (xy, steps),
        "track_angular": (angular, steps),
        "collision_force": (force, steps),
        "cost_of_transport": (power, weight * speed),
        "height": (height, steps),
        "speed": (speed, steps),
        "falls_per_minute": (falls, steps * (control_step / 60.0)),
    }
    return {name: _estimate(*ratio) for name, ratio in ratios.items()}


def _estimate(numerator: np.ndarray, denominator: np.ndarray) -> dict[str, float]:
    """Return a ratio of sums over robots with its standard error (delta method). Shapes: (robots,)."""
    total, count = denominator.sum(), len(numerator)
    if total == 0.0:
        return {"mean": float("nan"), "standard_error": float("nan")}
    mean = numerator.sum() / total
    if count == 1:
        return {"mean": float(mean), "standard_error": float("nan")}
    variance = np.square(numerator - mean * denominator).sum() * count / (count - 1)
    return {"mean": float(mean), "standard_error": float(np.sqrt(variance) / total)}
