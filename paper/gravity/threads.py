"""The number of CPU threads of torch."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """Let torch use one CPU thread inside; as a decorator, in a function.

    Factorizing many small matrices took 30 times as long with two threads as with one, on two cores with other work.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
