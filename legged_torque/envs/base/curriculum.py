"""The curriculum of eq. 1, for many values at once and on the device."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from legged_torque.envs.base.legged_robot_config import LinearChange


class LinearCurriculum:
    """Values that go linearly from ``start`` to ``end`` between ``t_start`` and ``t_end`` total steps (paper, eq. 1).

    A value is a function of the step count alone, so that a resumed training continues exactly where it was.
    """

    def __init__(self, settings: Sequence[LinearChange | type[LinearChange] | None], device: str) -> None:
        """Create one curriculum per entry; None stands for a constant 1."""
        rows = [(c.start, c.end, c.t_start, c.t_end) if c else (1.0, 1.0, 0, 1) for c in settings]
        start, end, t_start, t_end = torch.tensor(rows, dtype=torch.float64, device=device).view(-1, 4).unbind(dim=1)
        self._start, self._change = start, end - start
        self._t_start, self._duration = t_start, (t_end - t_start).clamp(min=1.0)

    def __call__(self, total_steps: Tensor) -> Tensor:
        """Return the values after ``total_steps`` (scalar, int64). Shape: (number of values,)."""
        progress = ((total_steps - self._t_start) / self._duration).clamp(0.0, 1.0)
        return (self._start + self._change * progress).float()
