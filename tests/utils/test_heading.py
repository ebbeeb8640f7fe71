"""The heading of a body, for numpy and for torch."""

import math

import numpy as np
import pytest
import torch

from legged_torque.utils.heading import heading
from legged_torque.utils.math import rotate_yaw, yaw


def turned(angle, tilt, about):
    """A turn about z [rad] after a tilt [rad] about a horizontal axis at an angle ``about``: (w, x, y, z)."""
    w, x, y = math.cos(tilt / 2), math.sin(tilt / 2) * math.cos(about), math.sin(tilt / 2) * math.sin(about)
    cos, sin = math.cos(angle / 2), math.sin(angle / 2)
    return np.array([cos * w, cos * x - sin * y, cos * y + sin * x, sin * w])


@pytest.mark.parametrize("angle", [-3.0, -0.4, 0.0, 1.2, 3.1])
@pytest.mark.parametrize("tilt", [0.0, 0.7, 2.0])
def test_heading(angle, tilt):
    """A tilt about a horizontal axis does not change the heading, and numpy and torch agree."""
    quat = turned(angle, tilt, 0.9)
    x, y, length = heading(quat)
    assert math.atan2(y, x) == pytest.approx(angle)
    assert (x / length, y / length) == pytest.approx((math.cos(angle), math.sin(angle)))
    quats, one = torch.from_numpy(np.stack([quat, quat])), torch.ones(2, dtype=torch.float64)
    torch.testing.assert_close(yaw(quats), angle * one)
    torch.testing.assert_close(rotate_yaw(quats, one, 0.0 * one), (math.cos(angle) * one, math.sin(angle) * one))


def test_upside_down():
    """Without a heading, results are finite."""
    x, y, length = heading(np.array([0.0, 1.0, 0.0, 0.0]))
    assert (x, y) == (0.0, 0.0) and length > 0.0
