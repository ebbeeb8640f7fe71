"""Replay of a function as one CUDA graph, with torch and Warp on the same stream."""

import contextlib
import os
from collections.abc import Callable, Iterator

import torch
import warp as wp

MAX_CAPTURED_STEPS = 64
"""Longer sequences of control steps replay step by step: their capture would take minutes and gigabytes."""

_STREAMS: dict[str, tuple[torch.cuda.Stream, wp.Stream]] = {}


def prepare_device(device: str) -> None:
    """Initialize Warp, and make one stream current for torch and Warp, on which everything runs and is captured.

    A CUDA graph cannot be captured on the default stream, and Warp forgets a stream with the object that wraps it.
    Hence one pair of streams per device is kept for the life of the process. "cpu" has no streams.
    """
    if torch.device(device).type != "cuda":
        with _silent_stderr():  # on a machine without a GPU, Warp's native code reports that there is no driver
            wp.init()
        return
    wp.init()
    if device not in _STREAMS:
        torch.cuda.set_device(device)
        stream = torch.cuda.Stream(device)
        stream.wait_stream(torch.cuda.current_stream(device))
        _STREAMS[device] = (stream, wp.stream_from_torch(stream))
    stream, warp_stream = _STREAMS[device]
    torch.cuda.set_stream(stream)
    wp.set_stream(warp_stream, device)


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Drop the output of native code to standard error."""
    kept = os.dup(2)
    with open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


class CudaGraph:
    """A function without arguments that runs once, is then captured, and then replayed.

    The function must read and write tensors of fixed address and shape and never wait for the host. The first call runs
    it eagerly, which compiles kernels and makes one-time allocations; the second call captures it. On the CPU, and
    during the capture of another graph, every call runs it eagerly.

    Attributes:
        enabled: Whether to capture and replay; otherwise every call runs the function eagerly.
    """

    def __init__(self, function: Callable[[], None], device: str, enabled: bool = True) -> None:
        """Prepare the graph; nothing runs yet."""
        self.enabled = enabled
        self._function, self._device, self._calls = function, device, 0
        self._is_cuda = torch.device(device).type == "cuda"
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        """Run, capture or replay the function."""
        is_eager = not self.enabled or not self._is_cuda or self._calls == 0
        if is_eager or torch.cuda.is_current_stream_capturing():
            self._calls += 1
            self._function()
            return
        self._graph = self._graph or self._capture()
        self._graph.replay()

    def reset(self) -> None:
        """Free the graph; the next call runs the function eagerly, the one after captures it anew."""
        self._calls, self._graph = 0, None

    def _capture(self) -> torch.cuda.CUDAGraph:
        """Record the function into a graph; the recorded work does not run."""
        stream, warp_stream = _STREAMS[self._device]
        graph = torch.cuda.CUDAGraph()
        with (
            torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"),
            wp.ScopedCapture(stream=warp_stream, external=True),
        ):
            self._function()
        return graph
