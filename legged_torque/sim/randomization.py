"""Drawing parameters of worlds at random, on the device, by mask."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged_torque.sim import kernels
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import Draw, Limits, check_value
from legged_torque.utils.mirroring import Mirroring


@dataclass
class RandomParameter:
    """Numbers of each world that are drawn together, uniformly in the ranges of one declaration.

    The ranges are given by operation: a "set" number replaces the robot's own value; otherwise an "add" number is added
    to it, and the sum is multiplied by a "scale" number and by a "scale_per_joint" number of each column's own. Nothing
    is drawn without a range. ``RandomParameter("thigh_mass", "body_mass", thighs, {"scale": [0.8, 1.2]}, shared=True)``
    draws one factor for the masses of some bodies.
    """

    name: str  # also of the observed number
    field: str | Tensor  # of the model, by its name, or a tensor. Shape: (num_envs, any)
    columns: Sequence[int]  # which numbers of a world, all entries of a field behind each other
    draw: dict[str, list[float]]  # the ranges
    unit: str = ""  # of the values
    own: Sequence[float] | float | None = None  # the robot's own values, per column; None: those at the start
    set_unit: Sequence[float] | float = 1.0  # of "set" numbers, per column or for all
    add_unit: Sequence[float] | float = 1.0  # of "add" numbers
    shared: bool = False  # whether all columns take the same draw, or each its own
    listed_by_column: bool = False  # whether a shared draw is listed as a number per column, as with "scale_per_joint"
    same_draw_as: str | None = None  # name of an earlier parameter whose draws it takes
    may_keep: bool = False  # whether it keeps its own value in a share of the draws
    limits: tuple[Sequence[float], Sequence[float]] | None = None  # lowest and highest, per column, to clip draws to
    bounds: Limits = dataclasses.field(default_factory=Limits)  # what no draw may leave, in the sign of the ranges
    at_reset_only: bool = False  # whether it is drawn at resets only
    mirror: Mirroring | None = None  # of the numbers listed; None: one number is its own image, several are unknown

    @property
    def is_drawn(self) -> bool:
        """Whether any range has more than one number."""
        return any(low < high for low, high in self.draw.values())

    @property
    def num_listed(self) -> int:
        """How many numbers :attr:`Randomization.values` has of it."""
        is_one = self.shared and "scale_per_joint" not in self.draw and not self.listed_by_column
        return 1 if is_one else len(self.columns)


class Randomization:
    """Draws all parameters of the worlds in a mask in one kernel, from one seed per world.

    Nothing waits for the host and nothing changes its address, so that it may run inside a CUDA graph.

    Attributes:
        parameters: What is drawn.
        fields: The tensors in which the parameters are kept, by the name of the model's field or of the parameter.
        sizes: How many numbers are listed of the parameters, by name: of those that share draws, one that is drawn.
        values: These numbers as they are now, from -1, the lowest one possible, to 1. Shape: (num_envs, their sum).
        seeds: From which the next draw follows; new ones are written by who draws. Shape: (num_envs,), int32.
    """

    def __init__(
        self,
        parameters: Sequence[RandomParameter],
        model_field: Callable[[str, Sequence[int]], Tensor],
        num_envs: int,
        device: str,
        keep_probability: float = 0.0,
    ) -> None:
        """Prepare the tables; nothing is drawn yet.

        ``model_field`` returns a field of the model to change some columns, see :meth:`Engine.field`. Parameters that
        may keep their own values do so in a share of draws, ``keep_probability``. A UserError if a parameter is not
        float32, has not two axes, or can leave its bounds.
        """
        self.parameters, self.fields = list(parameters), dict[str, Tensor]()
        self.sizes: dict[str, int] = {}
        rows: list[kernels.RandomNumber] = []
        at_start: list[float] = []
        first_draw: dict[str, int] = {}
        owners: dict[tuple[str | int, int], str] = {}  # who draws a number, by its field and place
        num_draws = 1  # number 0 decides what is kept
        for parameter in parameters:
            check_value(f"random parameter '{parameter.name}'", parameter.draw, Draw)
        listed = {each.same_draw_as or each.name: each for each in parameters[::-1]}
        listed |= {each.same_draw_as or each.name: each for each in parameters[::-1] if each.is_drawn}
        for parameter in parameters:
            field, of_draw = self._field(parameter, model_field), parameter.same_draw_as or parameter.name
            if parameter.same_draw_as and "scale_per_joint" in parameter.draw:
                raise UserError(f"random parameter '{of_draw}' takes no scale_per_joint: '{parameter.name}' follows it")
            start, is_listed = first_draw.setdefault(of_draw, num_draws), listed[of_draw] is parameter
            if is_listed:
                self.sizes[parameter.name] = parameter.num_listed
            if start == num_draws:
                num_draws += 1 if parameter.shared else len(parameter.columns)
            column_draw = num_draws if "scale_per_joint" in parameter.draw else None
            num_draws += len(parameter.columns) if column_draw is not None else 0
            table_rows = table(parameter, field, keep_probability)
            for i, (column, row) in enumerate(zip(parameter.columns, table_rows, strict=True)):
                row.address = field[:, column].data_ptr()
                number = (parameter.field if isinstance(parameter.field, str) else field.data_ptr(), column)
                if (owner := owners.setdefault(number, parameter.name)) != parameter.name:
                    both = f"'{owner}' and '{parameter.name}'"
                    raise UserError(f"random parameters {both} write the same number: leave one of them out")
                row.stride = field.stride(0) * field.element_size()
                row.draw = start + (0 if parameter.shared else i)
                row.column_draw = -1 if column_draw is None else column_draw + i
                row.place = -1
                if is_listed and i < parameter.num_listed:
                    row.place = len(at_start)
                    at_start.append((row.own_value - row.middle) * row.per_half_range)
                rows.append(row)
        self._refuse_views()
        self._without_rows = [name for name, field in self.fields.items() if len(field) != num_envs]
        self._device = device
        self.values = torch.tensor(at_start, device=device).repeat(num_envs, 1)
        self.seeds = torch.zeros(num_envs, dtype=torch.int32, device=device)
        self._rows: wp.array = wp.array(rows, dtype=kernels.RandomNumber, device=device)

    def range_of(self, name: str) -> tuple[int, float, float]:
        """Return the column of a parameter's first number in :attr:`values`, and the ends of that number's range."""
        place = sum(list(self.sizes.values())[: list(self.sizes).index(name)])
        (row,) = (row for row in self._rows.numpy() if row["place"] == place)
        half = 1.0 / row["per_half_range"] if row["per_half_range"] else 0.0
        return place, float(row["middle"] - half), float(row["middle"] + half)

    def own_fields(self) -> dict[str, Tensor]:
        """Return the tensors that are no fields of the model, by name of their parameter."""
        names = [parameter.name for parameter in self.parameters if isinstance(parameter.field, Tensor)]
        return {name: self.fields[name] for name in names}

    def _field(self, parameter: RandomParameter, model_field: Callable[[str, Sequence[int]], Tensor]) -> Tensor:
        """Return and keep the tensor of a parameter; a UserError unless the kernel can write to its addresses."""
        name, field, columns = parameter.name, parameter.field, list(parameter.columns)
        if isinstance(field, str):
            name, field = field, model_field(field, ()).flatten(1)
        kind, shape = field.dtype, tuple(field.shape)
        if kind != torch.float32 or len(shape) != 2:
            raise UserError(f"random parameter '{parameter.name}' must be float32 with two axes, not {kind} {shape}")
        if not columns or len({*columns}) < len(columns) or not {*columns} <= {*range(shape[1])}:
            allowed = f"different numbers from 0 to {shape[1] - 1}, one or more"
            raise UserError(f"the columns of random parameter '{parameter.name}' must be {allowed}, not {columns}")
        if isinstance(parameter.field, str):
            model_field(name, columns)
        self.fields[name] = field
        return field

    def _refuse_views(self) -> None:
        """Raise a UserError for a tensor that is a field of the model: what follows from it would stay as it was."""
        own = self.own_fields()
        storages = {self.fields[name].untyped_storage().data_ptr(): name for name in self.fields.keys() - own.keys()}
        for parameter, field in own.items():
            name = storages.get(field.untyped_storage().data_ptr())
            if name:
                raise UserError(f"the random parameter '{parameter}' is the model's '{name}': give its name")

    def draw(self, mask: Tensor) -> None:
        """Draw all parameters anew in the worlds of ``mask`` (num_envs,), bool; a UserError if worlds share one."""
        if self._without_rows:
            raise UserError(f"random parameters without a row per world: {', '.join(self._without_rows)}")
        arrays = [wp.from_torch(mask), wp.from_torch(self.seeds), self._rows, wp.from_torch(self.values)]
        wp.launch(kernels.draw_parameters, (len(self.values), len(self._rows)), arrays, device=self._device)


def fixed(parameter: RandomParameter) -> RandomParameter:
    """Return a parameter that keeps its own value, and has as many listed numbers."""
    listed = {"scale_per_joint": [1.0, 1.0]} if "scale_per_joint" in parameter.draw else {}
    return dataclasses.replace(parameter, draw=listed)


def table(parameter: RandomParameter, field: Tensor, keep_probability: float) -> list[Any]:
    """Return how each column of a parameter is drawn; a UserError if it can leave its bounds."""
    at_start = field[0, list(parameter.columns)].tolist()
    own, unit = at_start if parameter.own is None else parameter.own, parameter.add_unit
    if "set" in parameter.draw:
        own, unit = 0.0, parameter.set_unit
    draw = {"scale": (1.0, 1.0), "scale_per_joint": (1.0, 1.0), **parameter.draw}
    offset, scale = draw.get("set", draw.get("add", (0.0, 0.0))), draw["scale"]
    lowest, highest = parameter.limits or (-math.inf, math.inf)
    given = {"own": own, "set_unit or add_unit": unit, "limits[0]": lowest, "limits[1]": highest}
    for name, numbers in given.items():
        if np.shape(numbers) not in ((), (len(at_start),)):
            what = f"{name} of random parameter '{parameter.name}'"
            raise UserError(f"{what} must be one number or {len(at_start)}, one per column, not {numbers}")
    columns = [np.broadcast_to(numbers, len(at_start)).tolist() for numbers in given.values()]
    rows = []
    for default, base, weight, low, high in zip(at_start, *columns, strict=True):
        row: Any = kernels.RandomNumber()
        row.lowest, row.highest = low, high
        row.base, row.weight, row.own_value = base, weight, default
        row.offset_low, row.offset_span = offset[0], offset[1] - offset[0]
        row.scale_low, row.scale_span = scale[0], scale[1] - scale[0]
        of_column = draw["scale_per_joint"]
        row.column_low, row.column_span = of_column[0], of_column[1] - of_column[0]
        row.keep_probability = keep_probability if parameter.may_keep else 0.0
        corners = [(base + weight * add) * factor * other for add, factor, other in product(offset, scale, of_column)]
        for extreme in sorted(math.copysign(1.0, weight) * float(f"{corner:.6g}") for corner in corners):
            if not parameter.bounds.allow(extreme):
                raise UserError(
                    f"random parameter '{parameter.name}' can be {extreme:g} with the ranges given; it must be "
                    f"{parameter.bounds}"
                )
        half_range = (max(corners) - min(corners)) / 2
        row.middle = (max(corners) + min(corners)) / 2
        row.per_half_range = 1.0 / half_range if half_range > 0.0 else 0.0
        rows.append(row)
    return rows
