"""State of objects that hold tensors of all worlds: what a resumed training needs to go on with the same bits."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from legged_torque.utils.errors import UserError


class Buffers:
    """An object with tensors that have a row per world, are written in place and are part of checkpoints."""

    def __init__(self, num_envs: int, device: str) -> None:
        """Start without tensors."""
        self.num_envs, self.device = num_envs, device
        self._buffers: dict[str, Tensor] = {}

    def buffer(self, name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return zeros that :meth:`state_dict` contains under a name. Shape: (num_envs, *shape)."""
        self._buffers[name] = torch.zeros(self.num_envs, *shape, dtype=dtype, device=self.device)
        return self._buffers[name]

    def state_dict(self) -> dict[str, Any]:
        """Return the tensors by name; they are those in use, not copies."""
        return dict(self._buffers)


def copy_state(target: dict[str, Any], source: Any, name: str = "") -> None:
    """Copy nested dictionaries of tensors in place. A UserError names an entry that does not fit; then nothing changes.

    Args:
        target: What ``state_dict`` of an object returns.
        source: The same of another process.
        name: Where in a larger dictionary both stand.
    """
    for tensor, value in _pairs(target, source, name):
        tensor.copy_(value)


def _pairs(target: dict[str, Any], source: Any, name: str) -> list[tuple[Tensor, Tensor]]:
    """Return tensors and their new values."""
    if not isinstance(source, dict) or source.keys() != target.keys():
        known = source if isinstance(source, dict) else {}
        different = ", ".join(sorted(map(str, target.keys() ^ known.keys())))
        raise UserError(f"the state of '{name or 'the worlds'}' has other entries: {different}")
    pairs = []
    for key, tensor in target.items():
        path, value = f"{name}.{key}" if name else key, source[key]
        if isinstance(tensor, dict):
            pairs += _pairs(tensor, value, path)
            continue
        if not isinstance(value, Tensor) or (value.shape, value.dtype) != (tensor.shape, tensor.dtype):
            raise UserError(f"the state '{path}' is not of the shape {tuple(tensor.shape)} and the type {tensor.dtype}")
        pairs.append((tensor, value))
    return pairs
