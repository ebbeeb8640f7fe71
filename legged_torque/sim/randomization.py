"""Drawing parameters of worlds at random, on the device, by mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

Range = tuple[float, float]
"""Lowest and highest value."""


@dataclass
class Parameter:
    """Numbers of each world that are drawn together: value = (base + weight x U(offset)) x U(scale).

    Attributes:
        name: Key of its ranges in the settings.
        field: Where the numbers are kept, one row per world. Shape: (num_envs, any).
        columns: Which numbers of a row.
        base: What is added to, per column; None is the value at the start.
        weight: Factor on the offset, per column or for all.
        offset: Range of the offset.
        scale: Range of the scale.
        shared: Whether all columns take the same offset and scale, or each its own.
        same_draw_as: Name of an earlier parameter whose draws it takes.
        may_keep: Whether it keeps its value at the start in a share of the draws.
    """

    name: str
    field: Tensor
    columns: Sequence[int]
    base: Sequence[float] | float | None = None
    weight: Sequence[float] | float = 1.0
    offset: Range = (0.0, 0.0)
    scale: Range = (1.0, 1.0)
    shared: bool = False
    same_draw_as: str | None = None
    may_keep: bool = False


class Randomization:
    """Draws all parameters of the worlds in a mask in one kernel, from uniform numbers that torch generates.

    Nothing waits for the host and nothing changes its address, so that it may run inside a CUDA graph.
    """

    def __init__(self, parameters: Sequence[Parameter], num_envs: int, device: str, keep_probability: float) -> None:
        """Prepare the tables; nothing is drawn yet.

        Args:
            parameters: What to draw.
            num_envs: Number of worlds.
            device: "cpu" or "cuda:N".
            keep_probability: Share of draws in which the parameters that may keep their values at the start do so.
        """
        self._fields = [parameter.field for parameter in parameters]  # their memory must not be freed
        rows, addresses, strides, draws = [], [], [], []
        first_draw: dict[str, int] = {}
        num_draws = 1  # the first decides what is kept
        for parameter in parameters:
            count = 1 if parameter.shared else len(parameter.columns)
            start = first_draw.get(parameter.same_draw_as or "", num_draws)
            first_draw[parameter.name] = start
            if start == num_draws:
                num_draws += 2 * count
            defaults = parameter.field[0, list(parameter.columns)].tolist()
            bases = defaults if parameter.base is None else per_column(parameter.base, len(defaults))
            weights = per_column(parameter.weight, len(defaults))
            low, high = parameter.offset
            least, most = parameter.scale
            for i, column in enumerate(parameter.columns):
                keep = keep_probability if parameter.may_keep else 0.0
                rows.append((bases[i], weights[i], low, high - low, least, most - least, defaults[i], keep))
                addresses.append(parameter.field.data_ptr() + column * parameter.field.element_size())
                strides.append(parameter.field.stride(0) * parameter.field.element_size())
                draws.append(start + (0 if parameter.shared else 2 * i))
        self._num_envs, self._device = num_envs, device
        self._uniform = torch.zeros(num_envs, num_draws, device=device)
        self._mask = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._rows = wp.array(rows, dtype=_Row, device=device)
        self._addresses = wp.array(addresses, dtype=wp.uint64, device=device)
        self._strides = wp.array(strides, dtype=wp.uint64, device=device)
        self._draws = wp.array(draws, dtype=wp.int32, device=device)

    def draw(self, mask: Tensor) -> None:
        """Draw all parameters anew.

        Args:
            mask: In which worlds. Shape: (num_envs,), bool.
        """
        self._mask.copy_(mask)
        self._uniform.uniform_()
        wp.launch(
            _draw,
            dim=(self._num_envs, len(self._rows)),
            inputs=[
                wp.from_torch(self._mask),
                wp.from_torch(self._uniform),
                self._rows,
                self._addresses,
                self._strides,
                self._draws,
            ],
            device=self._device,
        )


_Row = wp.types.vector(length=8, dtype=wp.float32)
"""Of a column: base, weight, low and span of the offset, low and span of the scale, default, probability to keep it."""


@wp.kernel(enable_backward=False)
def _draw(
    mask: wp.array(dtype=wp.bool),
    uniform: wp.array2d(dtype=wp.float32),
    rows: wp.array(dtype=_Row),
    addresses: wp.array(dtype=wp.uint64),
    strides: wp.array(dtype=wp.uint64),
    draws: wp.array(dtype=wp.int32),
):
    """Write one number of one world."""
    world, column = wp.tid()
    if mask[world]:
        row = rows[column]
        first = draws[column]
        offset = row[2] + row[3] * uniform[world, first]
        scale = row[4] + row[5] * uniform[world, first + 1]
        value = (row[0] + row[1] * offset) * scale
        if uniform[world, 0] < row[7]:
            value = row[6]
        target = wp.array(ptr=addresses[column] + wp.uint64(world) * strides[column], shape=(1,), dtype=wp.float32)
        target[0] = value


def per_column(value: Sequence[float] | float, count: int) -> list[float]:
    """Return one number per column."""
    return [float(value)] * count if isinstance(value, (int, float)) else [float(v) for v in value]
