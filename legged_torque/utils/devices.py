"""The device of a process, its renderer, and the cores of the machine. MuJoCo must not be imported here."""

import contextlib
import ctypes.util
import importlib.util
import math
import os
import re
from pathlib import Path

from legged_torque.utils import distributed
from legged_torque.utils.errors import UserError, counted, unknown_name

MEMORY = Path("/proc/meminfo")  # and its memory
INSTALL_HINT = "on Debian: apt-get install libosmesa6, then MUJOCO_GL=osmesa"
_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}


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
    return f"CPU, {counted(torch.get_num_threads(), 'thread')}"


def free_memory(device: str) -> float:
    """Return how many bytes there are left for new tensors; of a CPU, inf elsewhere than on Linux."""
    import torch

    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    with contextlib.suppress(OSError, ValueError):
        lines = MEMORY.read_text().splitlines()
        return 1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    return math.inf


def disable_renderer() -> None:
    """Let MuJoCo import without a renderer, on which scripts that draw nothing must not depend."""
    os.environ["MUJOCO_GL"] = "disable"


def choose_offscreen_renderer() -> str | None:
    """Set ``MUJOCO_GL`` to a renderer that needs no screen; return why there is none, or None if there is one.

    To be called before MuJoCo is imported. The user's choice is taken if its library is installed; otherwise EGL where
    there is a GPU, then Mesa's software renderer. If there is none, MuJoCo imports without one, so that everything else
    works.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    if asked in _LIBRARIES:
        candidates = [asked]
    else:
        has_gpu = any(Path(path).exists() for path in ("/dev/nvidiactl", "/dev/dri"))
        candidates = ["egl", "osmesa"] if has_gpu else ["osmesa", "egl"]
    for name in candidates:
        if ctypes.util.find_library(_LIBRARIES[name]):
            os.environ["MUJOCO_GL"] = name
            if name == "osmesa" and importlib.util.find_spec("triton"):
                importlib.import_module("triton")  # after MuJoCo, it crashes: it and OSMesa have different LLVMs
            return None
    disable_renderer()
    return f"the library of {' or '.join(candidates)} is not installed ({INSTALL_HINT})"
