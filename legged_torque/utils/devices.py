"""The device of a process."""

from __future__ import annotations

import re

from legged_torque.utils import distributed
from legged_torque.utils.errors import UserError, unknown_name


def resolve_device(device: str | None) -> str:
    """Return "cpu" or "cuda:N" for "auto" (or None), "cpu", "cuda" or "cuda:N".

    Processes that train together take a GPU each; a UserError if there is no such device, or not one for each.
    """
    import torch  # not above: scripts read their command lines without it

    num_gpus = torch.cuda.device_count()
    available = ["cpu", *(f"cuda:{i}" for i in range(num_gpus))]
    if device in (None, "auto"):
        device = "cuda" if num_gpus else "cpu"
    if device == "cuda":
        num_processes = distributed.local_world_size()
        if 0 < num_gpus < num_processes:
            raise UserError(f"torchrun has started {num_processes} processes on a machine with {num_gpus} GPU(s)")
        device = f"cuda:{distributed.local_rank()}"
    elif device in available[1:] and distributed.world_size() > 1:
        raise UserError(f"with torchrun each process takes a GPU of its own: leave out --device {device}")
    if device not in available:
        if re.fullmatch(r"cuda:\d+", device):
            raise UserError(f"there is no device '{device}'; available: {', '.join(available)}")
        raise unknown_name("device", device, ["auto", *available])
    return device


def device_name(device: str) -> str:
    """Return the name of the hardware."""
    import torch

    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    threads = torch.get_num_threads()
    return f"CPU, {threads} thread{'s' if threads > 1 else ''}"
