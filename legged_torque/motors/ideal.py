"""Motors that give any torque within their limits at once."""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from legged_torque.motors.kernel import read
from legged_torque.motors.motor import Motor


@wp.struct
class TorqueLimits:
    """Inputs of :func:`limited_torque`."""

    limits: wp.array2d[float]  # lowest and highest [N m]; (2, num_dof)


@wp.func
def limited_torque(
    motors: TorqueLimits, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float
) -> float:
    """Return the torque, clipped to the limits; NaN stays NaN, as in torch."""
    low, high = motors.limits[0, joint], motors.limits[1, joint]
    return wp.where(wanted < low, low, wp.where(wanted > high, high, wanted))


class IdealMotor(Motor):
    """Limits of the torques, the same at any speed."""

    kernel = limited_torque

    def apply(self, wanted: Tensor, pos: Tensor, vel: Tensor, substep: int) -> Tensor:
        """Return the torques, clipped to the limits."""
        return torch.clamp(wanted, *self.joints.torque_limits)

    def kernel_reads(self) -> Any:
        """Return the limits."""
        return read(TorqueLimits, limits=self.joints.torque_limits)
