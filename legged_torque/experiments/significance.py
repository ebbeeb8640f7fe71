"""Tests of significance between a few seeds: Welch's t-test with Holm's correction, without scipy."""

from __future__ import annotations

import math
from statistics import fmean, variance

NEGLIGIBLE = 1e-16
"""Where the series of the incomplete beta function ends: the relative size of a term."""


def welch(first: list[float], second: list[float]) -> float | None:
    """Return the two-sided p value of Welch's t-test.

    None if it is undefined: with fewer than two values on a side, or without any variance.
    """
    if min(len(first), len(second)) < 2:
        return None
    shares = [variance(values) / len(values) for values in (first, second)]
    if sum(shares) == 0.0:
        return None
    t_squared = (fmean(first) - fmean(second)) ** 2 / sum(shares)
    freedom = sum(shares) ** 2 / sum(s**2 / (len(v) - 1) for s, v in zip(shares, (first, second), strict=True))
    return incomplete_beta(freedom / 2.0, 0.5, freedom / (freedom + t_squared))


def incomplete_beta(a: float, b: float, x: float) -> float:
    """Return the regularized incomplete beta function: the tail of Student's t for b = 1/2."""
    if x > 0.5:
        return 1.0 - incomplete_beta(b, a, 1.0 - x)
    if x == 0.0:
        return 0.0
    log_beta = math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
    term = math.exp(a * math.log(x) + b * math.log1p(-x) - log_beta) / a
    total, k = 0.0, 0
    while term > NEGLIGIBLE * total:  # terms are positive and shrink, in the end to less than 0.6 of the previous one
        total += term
        term *= x * (a + b + k) / (a + 1.0 + k)
        k += 1
    return total


def holm(p_values: list[float | None]) -> list[float | None]:
    """Return the p values with Holm's correction for as many tests as there are; None stays None."""
    order = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    corrected, largest = list(p_values), 0.0
    for rank, (p, i) in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p))
        corrected[i] = largest
    return corrected
