"""The statistics of a report: Student's t, Welch's test, Holm's correction."""

import math

import pytest

from legged_torque.experiments.significance import holm, incomplete_beta, welch


@pytest.mark.parametrize(
    ("t", "freedom", "p"),
    # tables of Student's t, and exact: 1 degree of freedom is Cauchy, 2 have 1 - t / sqrt(2 + t^2)
    [
        (12.7062047364, 1, 0.05),
        (1.0, 1, 0.5),
        (2.0, 2, 1 - 2 / math.sqrt(6)),
        (1e-3, 2, 1 - 1e-3 / math.sqrt(2 + 1e-6)),
        (2.4469118511, 6, 0.05),
        (3.7074280213, 6, 0.01),
        (2.0422724563, 30, 0.05),
        (1.9839715185, 100, 0.05),
    ],
)
def test_tail_of_student_t(t, freedom, p):
    """The incomplete beta function gives the tabulated tails."""
    assert incomplete_beta(freedom / 2, 0.5, freedom / (freedom + t * t)) == pytest.approx(p, rel=1e-8)


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


def test_welch_against_scipy():
    """Where scipy is installed, it gives the same p values."""
    stats = pytest.importorskip("scipy.stats")
    samples = ([0.1, 0.2, 0.4], [0.3, 0.31, 0.33, 0.5], [5.0, 5.1], [0.15, 0.21, 0.42, 0.1, 0.9, 0.3])
    for first in samples:
        for second in samples:
            expected = stats.ttest_ind(first, second, equal_var=False).pvalue
            assert welch(first, second) == pytest.approx(expected, rel=1e-9)


def test_holm_by_hand():
    """Each p value times the number of tests that are left, never less than the one before, and at most 1."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.01, None, 0.6, 0.7]) == [pytest.approx(0.03), None, 1.0, 1.0]
    assert holm([]) == [] and holm([None]) == [None]
