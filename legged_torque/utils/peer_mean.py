"""Means over GPUs of one machine, which read each other's memory; for so few numbers, NCCL takes longer."""

import torch
import torch.distributed._symmetric_memory as symmetric_memory
from torch import Tensor

_VECTOR = 4  # numbers that a GPU reads at once


class PeerMean:
    """Averages numbers of all processes, a GPU each; can be captured in a CUDA graph.

    Each adds all numbers in the order of the processes, so that they get the same bits.
    """

    def __init__(self, device: str) -> None:
        """Meet the others, with a device ("cuda:N"); a RuntimeError if GPUs cannot read each other's memory."""
        group = torch.distributed.group.WORLD
        assert group, "init_process_group() has been called"
        self._device, self._group = torch.device(device), group
        self._rows: dict[int, Tensor] = {}  # by how many numbers are averaged: what this process brings
        self.average(torch.zeros(1, device=device))

    def average(self, values: Tensor) -> Tensor:
        """Return the means over all processes, which call this in the same order. Shapes: (numbers,), float32.

        The first call with so many numbers cannot be captured.
        """
        size = len(values)
        if size not in self._rows:
            padded = size + -size % _VECTOR
            self._rows[size] = symmetric_memory.empty(padded, dtype=torch.float32, device=self._device).zero_()
            symmetric_memory.rendezvous(self._rows[size], self._group)
        self._rows[size][:size] = values
        total = torch.ops.symm_mem.one_shot_all_reduce(self._rows[size], "sum", self._group.group_name)
        return total[:size] / self._group.size()
