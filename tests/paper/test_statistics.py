"""The statistics of a report: Welch's test, Holm's correction."""

import math

import pytest

from legged_torque.paper.report.results import holm, welch


def test_welch_by_hand():
    """t and degrees of freedom that are not whole, and what cannot be told."""
    # variances 1 and 4, three values each: t = -3 / sqrt(5/3), freedom = (5/3)^2 / ((1/9 + 16/9) / 2) = 50/17
    freedom, t_squared = 50 / 17, 9 / (5 / 3)
    points = 200_000  # the density, integrated: t = sqrt(freedom) tan(angle)
    angles = [math.pi / 2 * (i + 0.5) / points for i in range(points)]
    density = [math.cos(angle) ** (freedom - 1) for angle in angles]
    start = math.atan(math.sqrt(t_squared / freedom))
    tail = sum(d for angle, d in zip(angles, density, strict=True) if angle > start) / sum(density)
    assert welch([1, 2, 3], [3, 5, 7]) == pytest.approx(tail, abs=1e-5)
    assert welch([1, 2, 3], [3, 5, 7]) == welch([3, 5, 7], [1, 2, 3])
    assert welch([1, 2], [1, 2]) == 1.0
    assert welch([1], [1, 2]) is None and welch([], [1, 2]) is None and welch([1, 1], [2, 2]) is None


def test_holm_by_hand():
    """Each p value times the number of tests that are left, never less than the one before, and at most 1."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.01, None, 0.6, 0.7]) == [pytest.approx(0.03), None, 1.0, 1.0]
    assert holm([]) == [] and holm([None]) == [None]
