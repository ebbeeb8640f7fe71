"""Motors that give any torque within their limits at once."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_torque.motors.motors import Motors


class IdealMotors(Motors):
    """Strength and limits, whatever the speed."""

    def apply(self, wanted: Tensor, dof_vel: Tensor, out: Tensor) -> None:
        """Write strength times torque, clipped to the limits."""
        torch.clamp(self.strength * wanted, self.limits[0], self.limits[1], out=out)
