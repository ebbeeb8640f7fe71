"""Motors that give any torque within their limits at once."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from legged_torque.motors.drive import in_kernel
from legged_torque.motors.motors import Motors


@wp.struct
class IdealMotor:
    """What :func:`ideal_torque` reads, see :class:`Motors`."""

    limits: wp.array2d[float]
    strength: wp.array2d[float]


@wp.func
def ideal_torque(motors: IdealMotor, world: int, joint: int, wanted: float, vel: float) -> float:
    """Return strength times torque, clipped to the limits; NaN stays NaN, as in torch."""
    torque = motors.strength[world, joint] * wanted
    low, high = motors.limits[0, joint], motors.limits[1, joint]
    return wp.where(torque < low, low, wp.where(torque > high, high, torque))


class IdealMotors(Motors):
    """Strength and limits, whatever the speed."""

    @in_kernel(ideal_torque)
    def apply(self, wanted: Tensor, dof_vel: Tensor, out: Tensor) -> None:
        """Write strength times torque, clipped to the limits."""
        torch.clamp(self.strength * wanted, self.limits[0], self.limits[1], out=out)
