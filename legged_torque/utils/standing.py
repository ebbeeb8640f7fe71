"""The criterion of a standing robot."""

from __future__ import annotations

from typing import Any, TypeAlias

Values: TypeAlias = Any  # a number, a numpy array or a tensor

LEAST_HEIGHT = 0.5  # of the trunk of a standing robot, as a share of its height in the nominal pose
MOST_TILT = 0.5  # [rad] of the trunk of a standing robot


def stands(height: Values, nominal_height: float, tilt: Values) -> Values:
    """Return whether a trunk is neither too low nor too tilted for a standing robot; NaN is not standing.

    Args:
        height: Height of the trunk above the ground [m].
        nominal_height: The same in the nominal pose [m].
        tilt: Angle between the trunk's vertical axis and that of the world [rad], of the shape of ``height``.
    """
    return (height > LEAST_HEIGHT * nominal_height) & (tilt < MOST_TILT)
