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
    """Checks all tensors of all worlds in two kernels, inside the step's CUDA graph, and counts on the device.

    A check is :meth:`begin`, :meth:`check` and :meth:`end`; first and last are torch's operations, to be compiled with
    what else a step does there.
    """

    def __init__(self, watched: Sequence[Watched], diverged: Tensor) -> None:
        """Prepare; what the first world has now takes the place of numbers that are not finite later.

        ``diverged`` is where worlds are marked. Shape: (num_envs,), bool.
        """
        self._marks = diverged
        self._watched = sorted(watched, key=lambda tensor: tensor.is_result)
        self._diverged, self._excused, nobody = diverged.new_zeros(3, len(diverged)).unbind()
        self._found = diverged.new_zeros(len(self._watched), len(diverged), dtype=torch.int32)
        self._counts = diverged.new_zeros(len(self._watched), dtype=torch.int32)
        self._causes = self._arguments(False, nobody, self._excused)
        self._results = self._arguments(True, self._excused, self._diverged)

    def _arguments(self, is_result: bool, excused: Tensor, marks: Tensor) -> list[Any]:
        """Return the kernel's arguments for the causes or the results; ``marks`` are further ones of their worlds."""
        chosen = [(i, tensor) for i, tensor in enumerate(self._watched) if tensor.is_result == is_result]
        rows = [row for i, tensor in chosen for row in columns(i, tensor.numbers)]
        table: wp.array = wp.array(rows, dtype=kernels.Column, device=wp.device_from_torch(excused.device))
        return [table, *map(wp.from_torch, (excused, self._marks, marks, self._found, self._counts))]

    def begin(self) -> None:
        """Note the worlds that have diverged already, whose results are not to blame."""
        self._excused.copy_(self._marks)

    def check(self) -> None:
        """Replace numbers that are not finite, and mark their worlds."""
        self._found.zero_()
        for arguments in (self._causes, self._results):
            parts = -(-len(arguments[0]) // kernels.COLUMNS_PER_THREAD)
            wp.launch(kernels.replace_non_finite, (len(self._marks), parts), arguments, device=arguments[0].device)

    def end(self) -> None:
        """Count the worlds that are marked."""
        self._diverged.logical_or_(self._marks)

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


def columns(i: int, numbers: Tensor) -> list[Any]:
    """Return where the numbers of the tensor number ``i`` are, and what takes their place."""
    rows = []
    for column, healthy in enumerate(numbers[0].tolist()):
        row: Any = kernels.Column()
        row.address, row.stride = numbers[:, column].data_ptr(), numbers.stride(0) * numbers.element_size()
        row.tensor, row.healthy = i, healthy
        rows.append(row)
    return rows
