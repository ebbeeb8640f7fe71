"""Where the streams of random numbers stand, so that a resumed run goes on with them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import Tensor


def random_state(device: str) -> dict[str, Tensor]:
    """Return the state of torch's generators: "cpu", and "cuda" if the device is a GPU."""
    state = {"cpu": torch.get_rng_state()}
    if torch.device(device).type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def restore_random_state(device: str, state: dict[str, Tensor]) -> None:
    """Continue the streams; that of a GPU only on a GPU.

    Args:
        device: "cpu" or "cuda:N".
        state: From :func:`random_state`.
    """
    torch.set_rng_state(state["cpu"].cpu())
    if torch.device(device).type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)


@contextlib.contextmanager
def own_random_numbers(device: str, state: dict[str, Tensor]) -> Iterator[None]:
    """Let what happens inside draw from a stream of its own, and leave torch's streams as they were.

    Args:
        device: "cpu" or "cuda:N".
        state: Where that stream stands, see :func:`random_state`; moved on in place.
    """
    outside = random_state(device)
    restore_random_state(device, state)
    try:
        yield
        state.update(random_state(device))
    finally:
        restore_random_state(device, outside)


def seeded_state(device: str, seed: int) -> dict[str, Tensor]:
    """Return the state of streams that start from a seed; torch's own stay where they are."""
    outside = random_state(device)
    try:
        torch.manual_seed(seed)
        return random_state(device)
    finally:
        restore_random_state(device, outside)
