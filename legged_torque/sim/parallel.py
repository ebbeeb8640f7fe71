"""Launch of a kernel over worlds on all cores of a CPU, of which Warp itself uses one."""

import functools
import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
import warp as wp

MIN_WORLDS = 8
"""Least number of worlds of a thread: with fewer, the hand-over takes as long as their physics."""


def launch_worlds(
    kernel: wp.Kernel, dim: Sequence[int], inputs: Sequence[Any], device: wp.Device, block_dim: int
) -> None:
    """Launch a kernel whose first dimension are worlds, on a CPU with as many threads as torch uses.

    The kernel's first argument is the index of the first world, which it adds to that of its thread; ``inputs`` are the
    other arguments. No world may read what the kernel writes for another one, so that the result is the same to the bit
    for any number of threads. Returns when the kernel has ended, on a GPU when it is enqueued.
    """
    num_worlds, *rest = dim
    parts = min(torch.get_num_threads(), num_worlds // MIN_WORLDS) if device.is_cpu else 1
    if parts <= 1:
        wp.launch(kernel, dim, [0, *inputs], block_dim=block_dim, device=device)
        return
    ends = [num_worlds * part // parts for part in range(parts + 1)]
    commands = [
        wp.launch(kernel, (end - first, *rest), [first, *inputs], block_dim=block_dim, device=device, record_cmd=True)
        for first, end in itertools.pairwise(ends)
    ]
    for launch in [_threads(parts).submit(command.launch) for command in commands]:  # without Python's lock
        launch.result()


@functools.cache
def _threads(number: int) -> ThreadPoolExecutor:
    """Return threads that live as long as the process."""
    return ThreadPoolExecutor(number, thread_name_prefix="worlds")
