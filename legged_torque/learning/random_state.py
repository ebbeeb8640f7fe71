"""States of the streams of random numbers, with which a resumed run goes on."""

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
    """Continue the streams of :func:`random_state`; that of a GPU only on a GPU."""
    torch.set_rng_state(state["cpu"].cpu())
    if torch.device(device).type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)


@contextlib.contextmanager
def own_random_numbers(device: str, state: dict[str, Tensor]) -> Iterator[None]:
    """Context that draws from a stream of its own, whose state moves on, and leaves torch's streams as they were."""
    gpus = [device] if torch.device(device).type == "cuda" else []
    with torch.random.fork_rng(gpus):
        restore_random_state(device, state)
        yield
        state.update(random_state(device))


def seeded_state(device: str, seed: int) -> dict[str, Tensor]:
    """Return the state of streams that start from a seed; torch's own stay where they are."""
    state = random_state(device)
    with own_random_numbers(device, state):
        torch.manual_seed(seed)
    return state
