"""Where the streams of random numbers stand, so that a resumed run goes on with them."""

from __future__ import annotations

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
