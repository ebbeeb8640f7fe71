"""Type annotations that bound settings. Validation, the reference page and ``--help`` are derived from them.

A plain type allows all its values, with numbers of ordinary size: ``float``, ``list[str]``, ``Literal["a", "b"]``.
``Annotated[float, Limits(...)]``, or one of the names below, allows fewer.
"""

import contextlib
import functools
import inspect
import math
import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from legged_torque.utils.errors import UserError, unknown_name

LARGEST = 1e9  # absolute value of a float; squares of larger ones leave float32
LARGEST_INT = 2**63 - 1  # absolute value of an integer, that of int64
_NAMES = {float: "a number", int: "an integer", str: "text", bool: "true or false", types.NoneType: "null"}
_PLURALS = {float: "numbers", int: "integers", str: "texts", list[str]: "lists of texts", Any: "values"}


@dataclass(frozen=True)
class Limits:
    """Bounds of all numbers of a setting, whether it is a number, a list or a dictionary."""

    lowest: float = -math.inf
    highest: float = math.inf
    above: float = -math.inf  # as lowest, but not allowed itself
    length: int | None = None  # of a list
    nonempty: bool = False  # whether a list needs at least one number
    ordered: bool = False  # whether a list is a range: [minimum, maximum]

    def __str__(self) -> str:
        """Return the bounds in words."""
        bounds = {"greater than": self.above, "at least": self.lowest, "at most": self.highest}
        text = " and ".join(f"{word} {number:.10g}" for word, number in bounds.items() if math.isfinite(number))
        if math.isfinite(self.lowest) and math.isfinite(self.highest):
            text = f"from {self.lowest:.10g} to {self.highest:.10g}"
        form = "[minimum, maximum]" if self.ordered else "one number or more" if self.nonempty else ""
        form = f"{self.length} numbers" if self.length else form
        return ", ".join(filter(None, (form, text)))

    def allow(self, value: Any) -> bool:
        """Return whether a value of the right type is within the bounds."""
        if isinstance(value, list):
            length = 2 if self.ordered else self.length or len(value)
            if len(value) != length or (self.nonempty and not value) or (self.ordered and value[0] > value[1]):
                return False
        return all(self.lowest <= number <= self.highest and number > self.above for number in _numbers(value))


class DrawLimits(Limits):
    """Bounds of a random parameter's ranges by operation."""

    def __str__(self) -> str:
        """Return the bounds in words."""
        return "ranges by operation: set, or add, scale and scale_per_joint; only those of add may be negative"

    def allow(self, value: Any) -> bool:
        """Return whether "set" is alone, and only added numbers are negative."""
        is_alone = "set" not in value or len(value) == 1
        return is_alone and all(limits[0] >= 0.0 for operation, limits in value.items() if operation != "add")


Positive = Annotated[float, Limits(above=0)]
NotNegative = Annotated[float, Limits(lowest=0)]
Share = Annotated[float, Limits(lowest=0, highest=1)]
Fraction = Annotated[float, Limits(above=0, highest=1)]
Count = Annotated[int, Limits(lowest=1)]
Number = Annotated[int, Limits(lowest=0)]
Rate = Annotated[float, Limits(above=0, highest=1e5)]
Worlds = Annotated[int, Limits(1, 10_000_000)]
Sizes = Annotated[list[int], Limits(lowest=1, highest=1e6, nonempty=True)]
Interval = Annotated[list[float], Limits(ordered=True)]
Draw = dict[Literal["set", "add", "scale", "scale_per_joint"], Interval]
Ranges = Annotated[Draw, DrawLimits()]
Activation = Literal[
    "elu", "selu", "relu", "crelu", "lrelu", "tanh", "sigmoid", "softplus", "gelu", "swish", "mish", "identity"
]
"""Activation functions that rsl_rl's networks know."""


def check_value(name: str, value: Any, hint: Any) -> Any:
    """Return a value in its type ``hint``, in which 2 may be 2.0, and 1e6 an integer.

    A UserError, in which the setting is called ``name``, if the type does not allow the value.
    """
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        value = check_value(name, value, parts[0])
        for limits in parts[1:]:
            if isinstance(limits, Limits) and not limits.allow(value):
                raise UserError(f"{name} must be {limits}, not {value}")
        return value
    if origin in (Union, types.UnionType):
        for part in parts:
            with contextlib.suppress(UserError):
                return check_value(name, value, part)
        return check_value(name, value, parts[0])  # its error is the user's
    if origin is Literal and isinstance(value, str) and value not in parts:
        raise unknown_name(name, value, map(str, parts))
    if origin is list and isinstance(value, list):
        return [check_value(f"{name}[{i}]", item, parts[0]) for i, item in enumerate(value)]
    if origin is dict and isinstance(value, dict):
        keys = (check_value(f"{name}.{key}", key, parts[0]) for key in value)
        return {key: check_value(f"{name}.{key}", value[key], parts[1]) for key in keys}
    kind = origin or hint
    if kind in (int, float):
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            if not abs(value) <= (LARGEST if kind is float else LARGEST_INT):
                size = f"finite, at most {LARGEST:g} either way" if kind is float else "an integer of 64 bits"
                raise UserError(f"{name} must be {size}, not {value}")
            if kind(value) == value:
                return kind(value)
    elif value in parts if kind is Literal else kind is Any or not isinstance(kind, type) or isinstance(value, kind):
        return value  # of a kind that is not a type, everything is
    raise UserError(f"{name} must be {describe(hint) or hint}, not {value!r}")


def describe(hint: Any) -> str:
    """Return the allowed values of a type in words."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        limits = ", ".join(str(part) for part in parts[1:] if isinstance(part, Limits))
        whole = " (integer)" if parts[0] is int else " (integers)" if parts[0] == list[int] else ""
        return f"{limits}{whole}" if limits else describe(parts[0])
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(describe, parts)))
    if origin is Literal:
        return " or ".join(map(str, parts))
    if origin is list:
        return f"a list of {_PLURALS.get(parts[0]) or describe(parts[0])}"
    if origin is dict:
        return f"{_PLURALS.get(parts[1]) or describe(parts[1])} by name"
    return _NAMES.get(hint, "")


@functools.cache
def types_of(section: type) -> dict[str, Any]:
    """Return the types that a class and its bases declare for their settings; a UserError if one is not known."""
    types: dict[str, Any] = {}
    for owner in reversed(section.__mro__):
        try:
            types |= inspect.get_annotations(owner, eval_str=True)
        except NameError as error:
            raise UserError(f"a type in {owner.__module__}.{owner.__qualname__} is not known: {error}") from None
    return types


def _numbers(value: Any) -> Iterator[float]:
    """Yield all numbers of a setting."""
    if isinstance(value, (list, dict)):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _numbers(part)
    elif value is not None:
        yield value
