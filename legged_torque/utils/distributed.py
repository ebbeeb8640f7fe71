"""Several processes that train one policy: on a GPU each, started by torchrun, or on a core each, started here.

Their number is known without torch, which scripts import after they have read their command lines.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from multiprocessing.pool import ThreadPool
from typing import TYPE_CHECKING, Any

from legged_torque.utils.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor

    from legged_torque.utils.shared_mean import SharedMean

MAX_PROCESSES = 8  # that this module starts: each holds 0.7 GB of memory
_END_WITH_PARENT = f"""
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, {int(signal.SIGTERM)}, 0, 0, 0)  # PR_SET_PDEATHSIG of linux/prctl.h
if os.getppid() == int(sys.argv[1]):  # else it has ended before
    os.execvp(sys.argv[2], sys.argv[2:])
"""
_PARENT = os.getppid()  # torchrun or the first process, if it has started this one
_POLL = 0.2  # seconds between looks at the processes that this one waits for
_WORD = 16  # bytes: tensors that travel together begin at its multiples, as the widest numbers (complex128) must
_started: list[subprocess.Popen] = []  # the others, in the process that has started them
_shared: SharedMean | None = None  # of processes that this module has started, once they have found each other


def world_size() -> int:
    """Return how many processes train together: 1 unless torchrun or :func:`use_cores` has started more."""
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
    """Return whether what has started this process has been killed, as torchrun may be: its processes live on."""
    return rank() > 0 and os.getppid() != _PARENT


def usable_cores() -> int:
    """Return how many cores this process may use: those that the system gives it, at most OMP_NUM_THREADS."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, int(limit)) if limit.isdecimal() and int(limit) > 0 else cores


def ending_with_parent(command: list[str]) -> list[str]:
    """Return a command whose process gets SIGTERM when this process ends for any reason, even when it is killed.

    Only Linux can do so; elsewhere the command is returned unchanged. ``preexec_fn`` of Popen would save one start of
    Python, but is not safe in a process with threads, such as a training.
    """
    if sys.platform != "linux":
        return command
    return [sys.executable, "-I", "-c", _END_WITH_PARENT, str(os.getpid()), *command]


def use_cores(num_processes: int) -> bool:
    """Let so many processes in all train together on the cores of this machine; return whether others were started.

    This process is the first one. The others run its command line, each with one thread, and end with it; they call
    this function as well, and start none. Numbers below 1e-38 count as 0, which saves a tenth of the time.
    """
    import torch

    if num_processes == world_size() == 1:
        return False
    torch.set_flush_denormal(True)
    if world_size() > 1:
        return False
    from legged_torque.utils.shared_mean import listen

    listen()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
    sizes = dict.fromkeys(("WORLD_SIZE", "LOCAL_WORLD_SIZE"), str(num_processes))
    os.environ.update({**address, **sizes, "RANK": "0", "LOCAL_RANK": "0", "OMP_NUM_THREADS": "1"})
    torch.set_num_threads(1)
    command = ending_with_parent([sys.executable, *sys.orig_argv[1:]])
    for number in map(str, range(1, num_processes)):
        _started.append(subprocess.Popen(command, env={**os.environ, "RANK": number, "LOCAL_RANK": number}))
    return True


def _variable(name: str, lowest: int) -> int:
    """Return the number that torchrun has put into an environment variable; ``lowest`` if it has not."""
    text = os.environ.get(name, str(lowest))
    if not text.isdecimal() or int(text) < lowest:
        raise UserError(f"the environment variable {name}, which torchrun sets, must be a number, not '{text}'")
    return int(text)


def join(device: str) -> None:
    """Join the other processes, if that is not done yet, to exchange tensors on a device ("cpu", "cuda:N").

    A UserError if they do not find each other, or one that this process has started ends before.
    """
    import torch

    if torch.distributed.is_initialized():
        return
    if not _started:
        _meet(device)
        return
    with ThreadPool(1) as pool:  # whose thread does not hear of a process that has ended
        meeting = pool.apply_async(_meet, [device])
        while not meeting.ready():
            meeting.wait(_POLL)
            if any(process.poll() is not None for process in _started):
                raise UserError("another process has ended before the training began")
        meeting.get()


def _meet(device: str) -> None:
    """Wait for the other processes, and connect to them; a UserError if they are not found."""
    import torch

    global _shared
    try:
        torch.distributed.init_process_group("nccl" if torch.device(device).type == "cuda" else "gloo")
        from legged_torque.utils.shared_mean import ADDRESS, SharedMean

        _shared = SharedMean(rank(), world_size()) if ADDRESS in os.environ else None
    except ValueError as error:  # an environment variable that torchrun sets is missing
        raise UserError(f"WORLD_SIZE is {world_size()}, but torchrun has not started this process: {error}") from None
    except torch.distributed.DistError as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UserError(f"the {world_size()} processes do not find each other: {reason}") from None


def average(tensors: list[Tensor]) -> None:
    """Replace tensors by their means over all processes, in one exchange; can be captured in a CUDA graph."""
    import torch

    flat = tensors[0].flatten() if len(tensors) == 1 else torch.cat([tensor.flatten() for tensor in tensors])
    if _shared:
        flat = _shared.average(flat)
    else:
        torch.distributed.all_reduce(flat)
        flat /= torch.distributed.get_world_size()
    for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
        if mean.data_ptr() != tensor.data_ptr():  # a single tensor has changed in place
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


def gather_tensors(content: Any, device: str) -> list[Any]:
    """Return nested containers of all processes, in their order, in the first one; nothing in the others.

    Tensors travel in one piece between devices ("cpu", "cuda:N"), and stay there. Containers and shapes may differ.
    """
    import torch
    from torch.utils._pytree import tree_leaves, tree_map_only

    if not torch.distributed.is_initialized():
        return [content]
    shapes = gather(tree_map_only(torch.Tensor, lambda tensor: tensor.to("meta"), content))
    tensors = [[leaf for leaf in tree_leaves(each) if torch.is_tensor(leaf)] for each in shapes]
    sizes = [[tensor.nbytes + -tensor.nbytes % _WORD for tensor in of_process] for of_process in tensors]
    flat = torch.zeros(max(map(sum, sizes)), dtype=torch.uint8, device=device)
    parts = [torch.empty_like(flat) for _ in shapes] if rank() == 0 else []

    def views(of: int, part: Tensor) -> list[Tensor]:
        """Return the places of a process's tensors in its part."""
        pieces = zip(part[: sum(sizes[of])].split(sizes[of]), tensors[of], strict=True)
        return [piece[: leaf.nbytes].view(leaf.dtype).view(leaf.shape) for piece, leaf in pieces]

    mine = [leaf for leaf in tree_leaves(content) if torch.is_tensor(leaf)]
    for view, tensor in zip(views(rank(), flat), mine, strict=True):
        view.copy_(tensor)
    torch.distributed.gather(flat, parts or None)

    def filled(of: int, part: Tensor) -> Any:
        """Return the containers of a process with its tensors."""
        own = iter(views(of, part))
        return tree_map_only(torch.Tensor, lambda _: next(own), shapes[of])

    return [filled(*each) for each in enumerate(parts)]


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
