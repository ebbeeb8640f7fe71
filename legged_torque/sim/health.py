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
    is_result: bool = False  # of the state and of other tensors, and not to blame where one of these was not finite

    @property
    def tag(self) -> str:
        """Name in the logs, without spaces."""
        return f"{self.kind.split()[0]}_{self.name}"

    def __str__(self) -> str:
        """Say what the user calls them."""
        return f"{self.kind} '{self.name}'"


class Health:
    """Checks all tensors of all worlds in two kernels, inside the step's CUDA graph, and counts on the device."""

    def __init__(self, watched: Sequence[Watched], num_envs: int, device: str) -> None:
        """Prepare; what the first world has now takes the place of numbers that are not finite later."""
        self._watched = sorted(watched, key=lambda tensor: tensor.is_result)
        self._defaults = [tensor.numbers[0].clone() for tensor in self._watched]  # their memory must not be freed
        rows = [address(*pair) for pair in zip(self._watched, self._defaults, strict=True)]
        num_causes = sum(not tensor.is_result for tensor in watched)
        self._causes: wp.array = wp.array(rows[:num_causes], dtype=kernels.Numbers2d, device=device)
        self._results: wp.array = wp.array(rows[num_causes:], dtype=kernels.Numbers2d, device=device)
        self._diverged, self._excused, self._nobody = torch.zeros(3, num_envs, dtype=torch.bool, device=device).unbind()
        self._counts = torch.zeros(len(rows), dtype=torch.int32, device=device)

    def check(self, diverged: Tensor) -> None:
        """Replace numbers that are not finite, and add their worlds to those that have diverged (num_envs,), bool."""
        num_causes = len(self._causes)
        self._mend(self._causes, self._nobody, diverged, self._counts[:num_causes])
        self._excused.copy_(diverged)
        self._mend(self._results, self._excused, diverged, self._counts[num_causes:])
        self._diverged.logical_or_(diverged)

    def _mend(self, rows: wp.array, *tensors: Tensor) -> None:
        """Run the kernel on some of the tensors."""
        arrays = [wp.from_torch(tensor) for tensor in tensors]
        wp.launch(kernels.mend, (len(rows), len(self._nobody)), [rows, *arrays], device=rows.device)

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


def address(tensor: Watched, defaults: Tensor) -> Any:
    """Return where a tensor's numbers are, and what takes their place."""
    row: Any = kernels.Numbers2d()
    size = tensor.numbers.element_size()
    row.address, row.defaults, row.count = tensor.numbers.data_ptr(), defaults.data_ptr(), len(defaults)
    row.world_stride, row.stride = (size * stride for stride in tensor.numbers.stride())
    return row
