"""State of objects that hold tensors of all worlds: what a resumed training needs to go on with the same bits."""

from typing import Any

import torch
from torch import Tensor

from legged_torque.utils.config import flat
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


def copy_state(target: dict[str, Any], source: Any) -> None:
    """Copy nested dictionaries of tensors, as ``state_dict`` of an object returns them, from those of another process.

    The tensors of ``target`` are written in place. A UserError names an entry that does not fit; then nothing changes.
    """
    tensors, values = flat(target), flat(source)
    if tensors.keys() != values.keys():
        different = sorted(tensors.keys() ^ values.keys())
        raise UserError(f"the state of the worlds has other entries: {', '.join(different)}")
    for path, tensor in tensors.items():
        value = values[path]
        if not isinstance(value, Tensor) or (value.shape, value.dtype) != (tensor.shape, tensor.dtype):
            raise UserError(f"the state '{path}' is not of the shape {tuple(tensor.shape)} and the type {tensor.dtype}")
    for path, tensor in tensors.items():
        tensor.copy_(values[path])
