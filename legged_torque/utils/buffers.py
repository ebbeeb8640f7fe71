"""State of objects that hold tensors of all worlds: what a resumed training needs to go on with the same bits."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.utils.config import flat
from legged_torque.utils.errors import UserError


class InPlace:
    """An object whose tensors others hold, too: they must be written in place."""

    _written_in_place: frozenset[str] = frozenset()

    def hold_tensors(self) -> None:
        """Refuse, by UserError, to bind an attribute that is a tensor now to another one."""
        tensors = [name for name, value in vars(self).items() if isinstance(value, (Tensor, TensorDict))]
        self._written_in_place = frozenset(tensors)

    def __setattr__(self, name: str, value: Any) -> None:
        """Bind an attribute, unless it is a tensor that others hold."""
        if name in self._written_in_place and value is not getattr(self, name):
            place = f"write {name} of {type(self).__name__} in place"
            raise UserError(f"{place}, {name}.copy_(...): a step would not see another tensor")
        super().__setattr__(name, value)


class Buffers(InPlace):
    """An object with tensors that have a row per world, are written in place and are part of checkpoints."""

    def __init__(self, num_envs: int, device: str) -> None:
        """Start without tensors."""
        self.num_envs, self.device = num_envs, device
        self._buffers: dict[str, Tensor] = {}

    def buffer(self, name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return zeros that :meth:`state_dict` contains under a new name. Shape: (num_envs, *shape)."""
        if name in self._buffers:
            raise UserError(f"{type(self).__name__} has the buffer '{name}' twice; give the second a name of its own")
        self._buffers[name] = torch.zeros(self.num_envs, *shape, dtype=dtype, device=self.device)
        return self._buffers[name]

    def state_dict(self) -> dict[str, Any]:
        """Return the tensors by name; they are those in use, not copies."""
        return dict(self._buffers)


def check_tensor(
    what: str, value: Any, shape: Sequence[int], device: str | torch.device, dtype: torch.dtype | None = None
) -> None:
    """Raise a UserError, which says ``what`` it is, unless a value is a tensor of this shape, place and type."""
    if isinstance(value, Tensor):
        expected = dtype or value.dtype, tuple(shape), torch.device(device)
        given = value.dtype, tuple(value.shape), value.device
        if given == expected:
            return
        words = ["{} {} on {}".format(str(kind).removeprefix("torch."), *where) for kind, *where in (expected, given)]
    else:
        words = [f"a tensor of the shape {tuple(shape)}", str(value)]
    raise UserError(f"{what} must be {words[0]}, not {words[1]}")


def copy_state(target: dict[str, Any], source: Any) -> None:
    """Copy nested dictionaries of tensors, as ``state_dict`` of an object returns them, from those of another process.

    The tensors of ``target`` are written in place. A UserError names an entry that does not fit; then nothing changes.
    """
    check_state(target, source)
    values = flat(source)
    for path, tensor in flat(target).items():
        tensor.copy_(values[path])


def check_state(target: dict[str, Any], source: Any) -> None:
    """Raise a UserError, which names an entry, if :func:`copy_state` cannot copy one state to the other."""
    tensors, values = flat(target), flat(source)
    if tensors.keys() != values.keys():
        different = sorted(tensors.keys() ^ values.keys())
        raise UserError(f"the state of the worlds has other entries: {', '.join(different)}")
    for path, tensor in tensors.items():
        value = values[path]
        if not isinstance(value, Tensor) or (value.shape, value.dtype) != (tensor.shape, tensor.dtype):
            raise UserError(f"the state '{path}' is not of the shape {tuple(tensor.shape)} and the type {tensor.dtype}")
