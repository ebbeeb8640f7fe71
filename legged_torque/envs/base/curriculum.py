"""Curricula on the device: of values, by the number of steps (eq. 1), and of commands, by how they are followed."""

from collections.abc import Sequence

import torch
from torch import Tensor

from legged_torque.envs.base.legged_robot_config import LinearChange

TRACKED = 0.8
"""Share of the highest tracking reward beyond which ranges grow, as in legged_gym."""
GROWTH = 0.1
"""Share of the full ranges by which they grow."""


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


class RangeCurriculum:
    """Ranges that grow as soon as robots track them well, like legged_gym's ``update_command_curriculum``.

    The mean over all worlds and the steps of a full episode decides. Every process of a training has its own ranges.

    Attributes:
        share: Share of the full ranges; they shrink towards their number that is nearest to 0. Shape: ().
    """

    def __init__(self, start: float, low: Tensor, span: Tensor, num_steps: int) -> None:
        """Start with a share of ranges, whose tensors in use are ``low`` and ``span``; decide after ``num_steps``."""
        self._low, self._span, self._full_low, self._full_span = low, span, low.clone(), span.clone()
        self._middle, self._num_steps = torch.zeros_like(low).clamp(low, low + span), num_steps
        self.share = torch.full_like(low[0], start)
        self._sums = torch.zeros(2, device=low.device)  # of the mean tracking, and steps
        self._set_ranges()

    def add_step(self, tracking: Tensor) -> None:
        """Add the tracking of a step, from 0 to 1. Shape: (num_envs,)."""
        self._sums[0].add_(tracking.mean())
        self._sums[1].add_(1.0)
        is_due = self._sums[1] >= self._num_steps
        grows = is_due & (self._sums[0] > TRACKED * self._num_steps)
        self.share.copy_((self.share + GROWTH * grows).clamp(max=1.0))
        self._sums.masked_fill_(is_due, 0.0)
        self._set_ranges()

    def state_dict(self) -> dict[str, Tensor]:
        """Return the share, and what decides on its growth."""
        return {"share": self.share, "sums": self._sums}

    def go_on(self, share: Tensor) -> None:
        """Continue from a share of the full ranges."""
        self.share.copy_(share)
        self._sums.zero_()
        self._set_ranges()

    def _set_ranges(self) -> None:
        """Write the ranges."""
        self._low.copy_(torch.lerp(self._middle, self._full_low, self.share))
        self._span.copy_(self.share * self._full_span)
