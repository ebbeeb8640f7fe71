"""Finding worlds with numbers that are not finite, and what these numbers were."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from legged_torque.sim import kernels
from legged_torque.utils import distributed


@dataclass(frozen=True, eq=False)
class Watched:
    """Numbers of each world that must be finite."""

    kind: str  # "reward term", "observation" or "buffer"
    name: str
    numbers: Tensor  # kept at this address. Shape: (num_envs, any)
    follow_state: bool = False  # whether they follow from the state, and are not to blame where it diverged

    @property
    def tag(self) -> str:
        """Name in the logs, without spaces."""
        return f"{self.kind.split()[0]}_{self.name}"

    def __str__(self) -> str:
        """Say what the user calls them."""
        return f"{self.kind} '{self.name}'"


class Health:
    """Checks all tensors of all worlds in one kernel, inside the step's CUDA graph, and counts on the device."""

    def __init__(self, watched: Sequence[Watched], num_envs: int, device: str) -> None:
        """Prepare; what the first world has now takes the place of numbers that are not finite later."""
        self._watched = list(watched)
        self._defaults = [tensor.numbers[0].clone() for tensor in watched]  # contiguous; their memory must not be freed
        rows = []
        for tensor, defaults in zip(watched, self._defaults, strict=True):
            row: Any = kernels.Numbers2d()
            size = tensor.numbers.element_size()
            row.address, row.defaults = tensor.numbers.data_ptr(), defaults.data_ptr()
            row.world_stride, row.stride = (size * stride for stride in tensor.numbers.stride())
            row.count, row.follow_state = len(defaults), tensor.follow_state
            rows.append(row)
        self._rows: wp.array = wp.array(rows, dtype=kernels.Numbers2d, device=device)
        self._broken, self._diverged = torch.zeros(2, num_envs, dtype=torch.bool, device=device).unbind()
        self._counts = torch.zeros(len(rows), dtype=torch.int32, device=device)
        self._device = device

    def check(self, diverged: Tensor) -> None:
        """Replace numbers that are not finite, and add their worlds to those that have diverged (num_envs,), bool."""
        self._broken.zero_()
        arrays = [wp.from_torch(tensor) for tensor in (diverged, self._broken, self._counts)]
        wp.launch(kernels.mend, (len(self._watched), len(diverged)), [self._rows, *arrays], device=self._device)
        diverged.logical_or_(self._broken)
        self._diverged.logical_or_(diverged)

    def read(self) -> tuple[float, dict[Watched, int]]:
        """Return what happened since the last call, over all processes that train together, and wait for the device.

        That is the share of the worlds that have diverged, and how often a world had to be reset for each of the
        tensors, those left out for which that did not happen.
        """
        numbers = torch.cat([self._diverged.float().mean().unsqueeze(0), self._counts.float()])
        self._diverged.zero_()
        self._counts.zero_()
        if torch.distributed.is_initialized():
            distributed.average([numbers])
        share, *means = numbers.tolist()
        counts = [round(mean * distributed.world_size()) for mean in means]
        return share, {tensor: count for tensor, count in zip(self._watched, counts, strict=True) if count}
