"""What a setting may be, as a type beside its default: validation, the reference page and ``--help`` follow from it.

A type of Python's own allows what its name says, with numbers of ordinary size only: ``float``, ``list[str]``,
``Literal["a", "b"]``. ``Annotated[float, Limits(...)]``, or one of the names below, says more.
"""

from __future__ import annotations

import functools
import inspect
import math
import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from legged_torque.utils.config import Section, section_keys
from legged_torque.utils.errors import UserError, unknown_name

LARGEST = 1e9  # absolute value of a float; squares of larger ones leave float32
LARGEST_INT = 2**63 - 1  # absolute value of an integer, that of int64


@dataclass(frozen=True)
class Limits:
    """What all numbers of a setting may be, whether it is one, a list or a dictionary; they are finite in any case."""

    lowest: float = -math.inf
    highest: float = math.inf
    above: float = -math.inf  # as lowest, but not allowed itself
    length: int | None = None  # how many numbers a list has
    nonempty: bool = False  # whether a list has one number or more
    ordered: bool = False  # whether a list is a range: [lowest, highest]

    def __str__(self) -> str:
        """Return what is allowed in words."""
        above, lowest, highest = (_plain(number) for number in (self.above, self.lowest, self.highest))
        bounds = [f"greater than {above}"] if self.above > -math.inf else []
        if self.lowest > -math.inf and self.highest < math.inf:
            bounds += [f"from {lowest} to {highest}"]
        else:
            bounds += [f"at least {lowest}"] if self.lowest > -math.inf else []
            bounds += [f"at most {highest}"] if self.highest < math.inf else []
        form = [f"{self.length} numbers"] if self.length else ["one number or more"] if self.nonempty else []
        form = ["[minimum, maximum]"] if self.ordered else form
        return ", ".join([*form, " and ".join(bounds)] if bounds else form)

    def allow(self, value: Any) -> bool:
        """Return whether a value of the right type is allowed."""
        numbers = list(_numbers(value))
        if isinstance(value, list):
            length = 2 if self.ordered else self.length
            if (length and len(numbers) != length) or (self.nonempty and not numbers):
                return False
            if self.ordered and numbers[0] > numbers[1]:
                return False
        return all(self.lowest <= number <= self.highest and number > self.above for number in numbers)


Positive = Annotated[float, Limits(above=0)]
NotNegative = Annotated[float, Limits(lowest=0)]
Share = Annotated[float, Limits(lowest=0, highest=1)]
Fraction = Annotated[float, Limits(above=0, highest=1)]
Count = Annotated[int, Limits(lowest=1)]
Number = Annotated[int, Limits(lowest=0)]
Worlds = Annotated[int, Limits(1, 10_000_000)]
Sizes = Annotated[list[int], Limits(lowest=1, highest=1e6, nonempty=True)]
Interval = Annotated[list[float], Limits(ordered=True)]
PositiveInterval = Annotated[list[float], Limits(above=0, ordered=True)]
NotNegativeInterval = Annotated[list[float], Limits(lowest=0, ordered=True)]


def check_section(section: Section, path: str = "") -> None:
    """Raise a UserError that names the first setting of a section, or below it, whose value is not allowed."""
    hints = types_of(type(section))
    for key in section_keys(section):
        value, dotted = getattr(section, key), f"{path}.{key}" if path else key
        if isinstance(value, Section):
            check_section(value, dotted)
        else:
            check_value(dotted, value, hints.get(key, object))


def check_value(name: str, value: Any, hint: Any) -> None:
    """Raise a UserError, in which the setting is called ``name``, if a value is not of the type ``hint``."""
    for number in _numbers(value):
        if not abs(number) <= (LARGEST if isinstance(number, float) else LARGEST_INT):
            size = "an integer of 64 bits" if isinstance(number, int) else f"finite, at most {LARGEST:g} either way"
            raise UserError(f"{name} must be {size}, not {value}")
    if _fits(value, hint):
        return
    if get_origin(hint) is Literal and isinstance(value, str):
        raise unknown_name(name, value, get_args(hint))
    hint = without_null(hint)
    parts = get_args(hint) if get_origin(hint) is Annotated else ()
    is_type_right = parts and _fits(value, parts[0])
    raise UserError(f"{name} must be {parts[1] if is_type_right else describe(hint)}, not {value!r}")


def without_null(hint: Any) -> Any:
    """Return a type that may be null as what it is otherwise."""
    is_union = get_origin(hint) in (Union, types.UnionType)
    return next(part for part in get_args(hint) if part is not types.NoneType) if is_union else hint


def describe(hint: Any) -> str:
    """Return what a type allows, in a few words."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        limits = ", ".join(str(part) for part in parts[1:] if isinstance(part, Limits))
        whole = " (integer)" if parts[0] is int else " (integers)" if parts[0] == list[int] else ""
        return f"{limits}{whole}" if limits else describe(parts[0])
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(describe(part) for part in parts))
    if origin is Literal:
        return " or ".join(str(part) for part in parts)
    if origin is list:
        return f"list of {describe(parts[0])}"
    if origin is dict:
        return f"{describe(parts[1])} by name"
    names = {float: "number", int: "integer", str: "text", bool: "true or false", types.NoneType: "null"}
    return names.get(hint, "")


def types_of(section: type) -> dict[str, Any]:
    """Return the types that a class and its bases declare for their settings; a UserError if one is not known."""
    return {name: hint for owner in reversed(section.__mro__) for name, hint in _own_types(owner).items()}


@functools.cache
def _own_types(owner: type) -> dict[str, Any]:
    """Return the types that a class itself declares."""
    try:
        return inspect.get_annotations(owner, eval_str=True)
    except NameError as error:
        raise UserError(f"a type in {owner.__module__}.{owner.__qualname__} is not known: {error}") from None


def _plain(number: float) -> str:
    """Return a number without an exponent."""
    return str(int(number)) if math.isfinite(number) and number == int(number) else f"{number:g}"


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value is of a type, and within its limits."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        limits = [part for part in parts[1:] if isinstance(part, Limits)]
        return _fits(value, parts[0]) and (value is None or all(limit.allow(value) for limit in limits))
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return value in parts
    if origin is list:
        return isinstance(value, list) and all(_fits(item, parts[0]) for item in value)
    if origin is dict:
        return isinstance(value, dict) and all(_fits(item, parts[1]) for item in value.values())
    if hint in (int, float):
        return isinstance(value, (int, hint)) and not isinstance(value, bool)
    return isinstance(value, hint) if isinstance(hint, type) else True


def _numbers(value: Any) -> Iterator[float]:
    """Yield all numbers of a setting."""
    if isinstance(value, (list, dict)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _numbers(item)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value
