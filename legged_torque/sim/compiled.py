"""Functions of torch's operations as a few kernels of a GPU, by ``torch.compile``."""

import contextlib
import importlib.util
import os
from collections.abc import Callable
from typing import Any

import torch
import warp as wp

from legged_torque.utils.display import warn
from legged_torque.utils.progress import TORCH_FOLDER, torch_compiles

SETTINGS: dict[str, Any] = {
    "backend": "inductor",
    "fullgraph": True,  # all or nothing: a part that cannot be compiled fails before anything has run
    "dynamic": False,
    "options": {
        "aggressive_fusion": True,  # one kernel for operations that share only the number of worlds
        "combo_kernels": True,  # one launch for several kernels that do not wait for each other
        "combo_kernels_autotune": 0,  # nothing is chosen by timing: that takes time, and additions keep their order
        "compile_threads": 1,  # the kernels are few: starting helpers takes longer
        "deterministic": True,
        "fallback_random": True,  # random numbers are torch's own
        "triton.autotune_pointwise": False,
    },
}
"""Arguments of ``torch.compile``, for operations of a number per world."""
NETWORK_SETTINGS = SETTINGS | {
    "options": SETTINGS["options"] | {"aggressive_fusion": False, "combo_kernels": False, "compile_threads": 8}
}
"""The same for networks that learn, whose combined kernels compile for minutes, or need too much memory."""
FIRST_TORCH = (2, 10)  # whose compiler promises the same bits in every process ("deterministic")
MOST_VERSIONS = 256  # of a function: one per task in the process, and per Python number that it reads


def has_triton(device: str) -> bool:
    """Return whether Triton's kernels run there: on a GPU that it knows, if it is installed."""
    if torch.device(device).type != "cuda" or not importlib.util.find_spec("triton"):
        return False
    return torch.cuda.get_device_capability(device) >= (7, 0)


def can_compile(device: str) -> bool:
    """Return whether functions are compiled there: by Triton, and by a torch that knows the settings above."""
    return has_triton(device) and tuple(map(int, torch.__version__.split(".")[:2])) >= FIRST_TORCH


def compiled(function: Callable, device: str, learns: bool = False) -> Callable:
    """Return a function that does the same with few kernels; the function itself where it cannot be compiled.

    It must only run operations of torch. What it keeps are tensors with fixed addresses, written in place. If it
    ``learns``, it is of networks, and its results have gradients.
    It is compiled at the first call, once per machine: the kernels are kept in a folder of Warp's cache. Where that
    is not possible, a line on standard error says so and names the place, and the function runs as it is.
    """
    return Compiled(function, learns) if can_compile(device) else function


class Compiled:
    """A function that is compiled at its first call."""

    def __init__(self, function: Callable, learns: bool) -> None:
        """Prepare; nothing is compiled yet."""
        import torch._dynamo as dynamo  # takes a second, and only a GPU needs it

        keep_kernels()
        dynamo.config.recompile_limit = max(dynamo.config.recompile_limit, MOST_VERSIONS)
        settings = NETWORK_SETTINGS if learns else SETTINGS
        self._function, self._run, self._has_run = function, torch.compile(function, **settings), False
        self._learns = learns

    def __call__(self, *args: Any) -> Any:
        """Run the function, always in the same mode of autograd, since each mode would be compiled separately."""
        with torch.inference_mode(False), torch.set_grad_enabled(self._learns):
            try:
                with contextlib.nullcontext() if self._has_run else torch_compiles():
                    result = self._run(*args)
            except torch._dynamo.exc.TorchDynamoException as error:  # nothing has run yet
                name = getattr(self._function, "__qualname__", str(self._function))
                warn(f"{name} runs uncompiled, which is slower: {reason(error)}")
                self._run = self._function
                result = self._run(*args)
            self._has_run = True
            return result


def keep_kernels() -> None:
    """Let torch and Triton keep their kernels in Warp's cache, unless the environment names other folders."""
    if wp.config.kernel_cache_dir:
        folder = os.path.join(wp.config.kernel_cache_dir, TORCH_FOLDER)
        os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", folder)
        os.environ.setdefault("TRITON_CACHE_DIR", os.path.join(folder, "triton"))


def reason(error: Exception) -> str:
    """Return in one line the reason why a function cannot be compiled, with the line of the code."""
    stack = getattr(error, "real_stack", None)
    place = f"{stack[-1].name} ({stack[-1].filename}:{stack[-1].lineno})" if stack else "no line is known"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{place}: {lines[0] if lines else type(error).__name__}"
