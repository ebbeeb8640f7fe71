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

    def __init__(self, watched: Sequence[Watched], diverged: Tensor) -> None:
        """Prepare; what the first world has now takes the place of numbers that are not finite later.

        ``diverged`` is where worlds are marked. Shape: (num_envs,), bool.
        """
        self._marks = diverged
        self._watched = sorted(watched, key=lambda tensor: tensor.is_result)
        self._defaults = [tensor.numbers[0].clone() for tensor in self._watched]  # their memory must not be freed
        rows = [address(*pair) for pair in zip(self._watched, self._defaults, strict=True)]
        self._diverged, self._excused, nobody = diverged.new_zeros(3, len(diverged)).unbind()
        self._counts = torch.zeros(len(rows), dtype=torch.int32, device=diverged.device)
        num_causes = sum(not tensor.is_result for tensor in watched)
        self._causes = self._arguments(rows[:num_causes], nobody, self._counts[:num_causes])
        self._results = self._arguments(rows[num_causes:], self._excused, self._counts[num_causes:])

    def _arguments(self, rows: list[Any], excused: Tensor, counts: Tensor) -> list[Any]:
        """Return the kernel's arguments for some of the tensors."""
        table: wp.array = wp.array(rows, dtype=kernels.Numbers2d, device=wp.device_from_torch(excused.device))
        return [table, *map(wp.from_torch, (excused, self._marks, counts))]

    def check(self) -> None:
        """Replace numbers that are not finite, and mark their worlds."""
        self._mend(self._causes)
        self._excused.copy_(self._marks)
        self._mend(self._results)
        self._diverged.logical_or_(self._marks)

    def _mend(self, arguments: list[Any]) -> None:
        """Run the kernel."""
        rows = arguments[0]
        wp.launch(kernels.mend, (len(rows), len(self._marks)), arguments, device=rows.device)

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
    row.address, row.defaults, row.count = tensor.numbers.data_ptr(), defaults.data_ptr(), len(defaults)
    row.world_stride = tensor.numbers.stride(0) * tensor.numbers.element_size()
    row.stride = tensor.numbers.stride(1)
    return row
