"""Detection of worlds with numbers that are not finite, and of the tensors that caused them."""

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
    is_derived: bool = False  # computed from other tensors; not reported where one of those was not finite

    @property
    def tag(self) -> str:
        """Name in the logs, without spaces."""
        return f"{self.kind.split()[0]}_{self.name}"

    def __str__(self) -> str:
        """Return kind and name."""
        return f"{self.kind} '{self.name}'"


class Health:
    """Checks all tensors of all worlds in two kernels, inside the step's CUDA graph, and counts on the device.

    A check is :meth:`begin`, :meth:`check` and :meth:`end`. The first and the last are torch operations, which compile
    together with their surroundings.
    """

    def __init__(self, watched: Sequence[Watched], diverged: Tensor) -> None:
        """Prepare; the first world's present numbers replace later ones that are not finite.

        Worlds are marked in ``diverged``. Shape: (num_envs,), bool.
        """
        self._marks = diverged
        self._watched = sorted(watched, key=lambda tensor: tensor.is_derived)
        self._diverged, self._excused, none = diverged.new_zeros(3, len(diverged)).unbind()
        self._found = diverged.new_zeros(len(self._watched), len(diverged), dtype=torch.int32)
        self._counts = diverged.new_zeros(len(self._watched), dtype=torch.int32)
        self._causes = self._arguments(False, none, self._excused)
        self._derived = self._arguments(True, self._excused, self._diverged)

    def _arguments(self, is_derived: bool, excused: Tensor, marks: Tensor) -> list[Any]:
        """Return the kernel's arguments for causes or derived tensors; ``marks`` is a second mask for their worlds."""
        chosen = [(i, tensor) for i, tensor in enumerate(self._watched) if tensor.is_derived == is_derived]
        rows = [row for i, tensor in chosen for row in columns(i, tensor.numbers)]
        table: wp.array = wp.array(rows, dtype=kernels.WatchedNumber, device=wp.device_from_torch(excused.device))
        return [table, *map(wp.from_torch, (excused, self._marks, marks, self._found, self._counts))]

    def begin(self) -> None:
        """Excuse the derived tensors of worlds that have diverged already."""
        self._excused.copy_(self._marks)

    def check(self) -> None:
        """Replace numbers that are not finite, and mark their worlds."""
        self._found.zero_()
        for arguments in (self._causes, self._derived):
            parts = -(-len(arguments[0]) // kernels.COLUMNS_PER_THREAD)
            wp.launch(kernels.replace_non_finite, (len(self._marks), parts), arguments, device=arguments[0].device)

    def end(self) -> None:
        """Count the worlds that are marked."""
        self._diverged.logical_or_(self._marks)

    def read(self) -> tuple[float, dict[Watched, int]]:
        """Return and clear the counts of all processes that train together; waits for the device.

        Returns:
            The share of the worlds that have diverged, and the number of resets that each tensor has caused, without
            tensors that have caused none.
        """
        numbers = torch.cat([self._diverged.float().mean().unsqueeze(0), self._counts.float()])
        self._diverged.zero_()
        self._counts.zero_()
        if torch.distributed.is_initialized():
            distributed.average([numbers])
        share, *means = numbers.tolist()
        found = ((tensor, mean) for tensor, mean in zip(self._watched, means, strict=True) if mean)
        return share, {tensor: round(mean * distributed.world_size()) for tensor, mean in found}


def columns(i: int, numbers: Tensor) -> list[Any]:
    """Return the places in memory of tensor number ``i``, and the replacements."""
    rows = []
    for column, healthy in enumerate(numbers[0].tolist()):
        row: Any = kernels.WatchedNumber()
        row.address, row.stride = numbers[:, column].data_ptr(), numbers.stride(0) * numbers.element_size()
        row.tensor, row.healthy = i, healthy
        rows.append(row)
    return rows
