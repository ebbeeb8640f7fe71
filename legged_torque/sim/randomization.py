"""Drawing parameters of worlds at random, on the device, by mask."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
import warp as wp
from torch import Tensor

from legged_torque.sim import kernels
from legged_torque.utils.errors import UserError
from legged_torque.utils.mirroring import Mirroring

Range = tuple[float, float]  # lowest and highest value


@dataclass
class Parameter:
    """Numbers of each world that are drawn together.

    Their value is (base + weight x U(offset)) x U(scale) x U(column_scale), U being uniform in a range.
    """

    name: str  # key of its ranges in the settings
    field: Tensor  # where the numbers are kept, one row per world. Shape: (num_envs, any)
    columns: Sequence[int]  # which numbers of a row
    base: Sequence[float] | float | None = None  # what is added to, per column; None is the value at the start
    weight: Sequence[float] | float = 1.0  # factor on the offset, per column or for all
    offset: Range = (0.0, 0.0)
    scale: Range = (1.0, 1.0)
    column_scale: Range | None = None  # a further factor, of each column even where the others are shared
    shared: bool = False  # whether all columns take the same offset and scale, or each its own
    listed_by_column: bool = False  # whether a shared draw is listed as a number per column, as with column_scale
    same_draw_as: str | None = None  # name of an earlier parameter whose draws it takes
    may_keep: bool = False  # whether it keeps its value at the start in a share of the draws
    limits: tuple[Sequence[float], Sequence[float]] | None = None  # lowest and highest, per column, to clip draws to
    model_field: str | None = None  # name of the field of the model that ``field`` shows; None if it is none
    at_least: float = -math.inf  # what no draw may be below
    mirror: Mirroring | None = None  # of the numbers listed; None: one number is its own image, several are unknown

    @property
    def num_listed(self) -> int:
        """How many numbers :attr:`Randomization.values` has of it."""
        is_one = self.shared and self.column_scale is None and not self.listed_by_column
        return 1 if is_one else len(self.columns)


_NUMBERS_PER_BODY = {"body_mass": 1, "body_inertia": 3, "body_ipos": 3, "body_iquat": 4, "body_pos": 3, "body_quat": 4}
"""Fields of the model on which the inverse weights of legs depend, apart from armatures."""
_TRUNK = 1  # the trunk's body


def changes_legs(parameters: Sequence[Parameter]) -> bool:
    """Return whether masses or places of bodies other than the trunk are drawn, see ``Engine.vary_legs``."""
    widths = [(_NUMBERS_PER_BODY.get(parameter.model_field or ""), parameter) for parameter in parameters]
    return any(width and any(i // width != _TRUNK for i in parameter.columns) for width, parameter in widths)


class Randomization:
    """Draws all parameters of the worlds in a mask in one kernel, from one seed per world.

    Nothing waits for the host and nothing changes its address, so that it may run inside a CUDA graph.

    Attributes:
        parameters: What is drawn.
        sizes: How many numbers of their own the parameters have, by name; those that take others' draws are left out.
        values: These numbers as they are now, from -1, the lowest one possible, to 1. Shape: (num_envs, their sum).
        seeds: From which the next draw follows; new ones are written by who draws. Shape: (num_envs,), int32.
    """

    def __init__(
        self, parameters: Sequence[Parameter], num_envs: int, device: str, keep_probability: float = 0.0
    ) -> None:
        """Prepare the tables; nothing is drawn yet. A UserError if a parameter is not float32 or has not two axes.

        Parameters that may keep their values at the start do so in a share of draws, ``keep_probability``.
        """
        self.parameters = list(parameters)  # the memory of their fields must not be freed
        self._without_rows = [parameter.name for parameter in parameters if len(parameter.field) != num_envs]
        self.sizes: dict[str, int] = {}
        rows: list[kernels.Row] = []
        at_start: list[float] = []
        first_draw: dict[str, int] = {}
        num_draws = 1  # number 0 decides what is kept
        for parameter in parameters:
            check_field(parameter)
            count = 1 if parameter.shared else len(parameter.columns)
            start = first_draw.setdefault(parameter.same_draw_as or parameter.name, num_draws)
            is_new = start == num_draws
            if is_new:
                self.sizes[parameter.name] = parameter.num_listed
                num_draws += count
            column_draw = num_draws if parameter.column_scale else None
            num_draws += len(parameter.columns) if parameter.column_scale else 0
            for i, (column, row) in enumerate(zip(parameter.columns, table(parameter, keep_probability), strict=True)):
                row.address = parameter.field[:, column].data_ptr()
                row.stride = parameter.field.stride(0) * parameter.field.element_size()
                row.draw = start + (0 if parameter.shared else i)
                row.column_draw = -1 if column_draw is None else column_draw + i
                row.place = -1
                if is_new and i < parameter.num_listed:
                    row.place = len(at_start)
                    at_start.append((row.own_value - row.middle) * row.per_half_range)
                rows.append(row)
        self._device = device
        self.values = torch.tensor(at_start, device=device).repeat(num_envs, 1)
        self.seeds = torch.zeros(num_envs, dtype=torch.int32, device=device)
        self._rows: wp.array = wp.array(rows, dtype=kernels.Row, device=device)

    def draw(self, mask: Tensor) -> None:
        """Draw all parameters anew in the worlds of ``mask`` (num_envs,), bool; a UserError if worlds share one."""
        if self._without_rows:
            raise UserError(f"random parameters without a row per world: {', '.join(self._without_rows)}")
        arrays = [wp.from_torch(mask), wp.from_torch(self.seeds), self._rows, wp.from_torch(self.values)]
        wp.launch(kernels.draw, (len(self.values), len(self._rows)), arrays, device=self._device)


def check_field(parameter: Parameter) -> None:
    """Raise a UserError unless a parameter's numbers are of the kind that the kernel writes to their addresses."""
    kind, shape = parameter.field.dtype, tuple(parameter.field.shape)
    if kind != torch.float32 or len(shape) != 2:
        raise UserError(f"random parameter '{parameter.name}' must be float32 with two axes, not {kind} {shape}")


def table(parameter: Parameter, keep_probability: float) -> list[Any]:
    """Return how each column of a parameter is drawn; a UserError if it can fall below what it may be."""
    defaults = parameter.field[0, list(parameter.columns)].tolist()
    bases = defaults if parameter.base is None else per_column(parameter.base, len(defaults))
    weights = per_column(parameter.weight, len(defaults))
    column_scale = parameter.column_scale or (1.0, 1.0)
    lowest, highest = parameter.limits or ([-math.inf] * len(defaults), [math.inf] * len(defaults))
    rows = []
    for default, base, weight, low, high in zip(defaults, bases, weights, lowest, highest, strict=True):
        row: Any = kernels.Row()
        row.lowest, row.highest = low, high
        row.base, row.weight, row.own_value = base, weight, default
        row.offset_low, row.offset_span = parameter.offset[0], parameter.offset[1] - parameter.offset[0]
        row.scale_low, row.scale_span = parameter.scale[0], parameter.scale[1] - parameter.scale[0]
        row.column_low, row.column_span = column_scale[0], column_scale[1] - column_scale[0]
        row.keep_probability = keep_probability if parameter.may_keep else 0.0
        offsets, scales = parameter.offset, product(parameter.scale, column_scale)
        corners = [(base + weight * offset) * scale * own for offset, (scale, own) in product(offsets, scales)]
        if min(corners) < parameter.at_least:
            raise UserError(
                f"random parameter '{parameter.name}' can be {min(corners):g} with the ranges given; it must be at "
                f"least {parameter.at_least:g}"
            )
        half_range = (max(corners) - min(corners)) / 2
        row.middle = (max(corners) + min(corners)) / 2
        row.per_half_range = 1.0 / half_range if half_range > 0.0 else 0.0
        rows.append(row)
    return rows


def per_column(value: Sequence[float] | float, count: int) -> list[float]:
    """Return one number per column."""
    return [float(value)] * count if isinstance(value, (int, float)) else [float(v) for v in value]
