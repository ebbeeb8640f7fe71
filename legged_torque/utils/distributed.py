"""Several processes that train one policy, each on a GPU of its own, started by torchrun.

Their number is known without torch, which scripts import after they have read their command lines.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from legged_torque.utils.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor


_PARENT = os.getppid()  # torchrun, if it has started this process


def world_size() -> int:
    """Return how many processes train together: 1 unless torchrun has started more."""
    return _variable("WORLD_SIZE", 1)


def rank() -> int:
    """Return the number of this process among all of them."""
    return _variable("RANK", 0) if world_size() > 1 else 0


def local_world_size() -> int:
    """Return how many of the processes run on this machine."""
    return _variable("LOCAL_WORLD_SIZE", 1) if world_size() > 1 else 1


def local_rank() -> int:
    """Return the number of this process among those on this machine, which is that of its GPU."""
    return _variable("LOCAL_RANK", 0) if world_size() > 1 else 0


def has_lost_parent() -> bool:
    """Return whether torchrun has been killed: the processes that it has started live on."""
    return world_size() > 1 and os.getppid() != _PARENT


def _variable(name: str, lowest: int) -> int:
    """Return the number that torchrun has put into an environment variable; ``lowest`` if it has not."""
    text = os.environ.get(name, str(lowest))
    if not text.isdecimal() or int(text) < lowest:
        raise UserError(f"the environment variable {name}, which torchrun sets, must be a number, not '{text}'")
    return int(text)


def join(device: str) -> None:
    """Join the other processes, if that is not done yet, to exchange tensors on a device ("cpu", "cuda:N")."""
    import torch

    if torch.distributed.is_initialized():
        return
    try:
        torch.distributed.init_process_group("nccl" if torch.device(device).type == "cuda" else "gloo")
    except ValueError as error:  # an environment variable that torchrun sets is missing
        raise UserError(f"WORLD_SIZE is {world_size()}, but torchrun has not started this process: {error}") from None
    except torch.distributed.DistError as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UserError(f"the {world_size()} processes do not find each other: {reason}") from None


def average(tensors: list[Tensor]) -> None:
    """Replace tensors by their means over all processes, in one exchange; can be captured in a CUDA graph."""
    import torch

    flat = torch.cat([tensor.flatten() for tensor in tensors])
    torch.distributed.all_reduce(flat)
    flat /= torch.distributed.get_world_size()
    for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(mean.view_as(tensor))


def any_process(condition: bool, device: str) -> bool:
    """Return whether a condition holds in any process, and wait for all of them."""
    import torch

    if not torch.distributed.is_initialized():
        return condition
    flag = torch.tensor(float(condition), device=device)
    torch.distributed.all_reduce(flag)
    return flag.item() > 0.0


def gather(value: Any) -> list[Any]:
    """Return the values of all processes, in their order."""
    import torch

    if not torch.distributed.is_initialized():
        return [value]
    values: list[Any] = [None] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(values, value)
    return values


def from_first(value: Any, device: str) -> Any:
    """Return the value of the first process in all of them, sent between devices ("cpu", "cuda:N")."""
    import torch

    values = [value]
    torch.distributed.broadcast_object_list(values, src=0, device=torch.device(device))
    return values[0]


def check_same(settings: dict[str, Any]) -> None:
    """Raise a UserError for a setting that differs between processes: each machine has its own command line."""
    first, *others = gather(settings)
    for number, other in enumerate(others, 1):
        for name in sorted(first.keys() | other.keys()):
            if repr(first.get(name)) != repr(other.get(name)):
                values = f"{other.get(name)} in process {number}, but {first.get(name)} in the first one"
                raise UserError(f"processes that train together must have the same settings: {name} is {values}")
