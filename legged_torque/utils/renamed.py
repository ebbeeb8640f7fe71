"""Settings that have other names than in an earlier version, in the runs and on the command lines of their users."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from legged_torque.utils.errors import UserError
from legged_torque.utils.plain_yaml import parse_value

Renamed: TypeAlias = Mapping[str, str | Callable[[Any], dict[str, Any]]]
"""By old dotted path of a setting or a section: its new path, or a function of the old value.

The function returns the new values by their paths, none if the old value meant nothing. Entries are applied in their
order; a later one overrides what an earlier one has set.
"""


def with_new_names(values: dict[str, Any], renamed: Renamed) -> dict[str, Any]:
    """Return the settings of a run, as nested dictionaries, under their names of today."""
    values = copy.deepcopy(values)
    for old, new in renamed.items():
        try:
            value = _pop(values, old)
        except (KeyError, TypeError, AttributeError):  # the run does not have it
            continue
        for path, entry in ({new: value} if isinstance(new, str) else new(value)).items():
            _set(values, path, entry)
    return values


def _pop(values: dict[str, Any], path: str) -> Any:
    """Remove an entry of nested dictionaries, with the sections that are empty then, and return its value."""
    key, _, rest = path.partition(".")
    if not rest:
        return values.pop(key)
    value = _pop(values[key], rest)
    if not values[key]:
        del values[key]
    return value


def _set(values: dict[str, Any], path: str, value: Any) -> None:
    """Set an entry of nested dictionaries; a section keeps its other entries."""
    *sections, key = path.split(".")
    for section in sections:
        values = values.setdefault(section, {})
    values[key] = values[key] | value if isinstance(values.get(key), dict) and isinstance(value, dict) else value


def check_is_current(path: str, value: Any, renamed: Renamed) -> None:
    """Raise a UserError with the new name if ``path``, which a user sets to ``value``, is that of a renamed setting."""
    for old, new in renamed.items():
        if f"{path}.".startswith(f"{old}."):
            if isinstance(new, str):
                raise UserError(f"'{path}' is now '{new}{path[len(old) :]}'")
            try:
                new_values = new(parse_value(value) if isinstance(value, str) else value)
                entries = " and ".join(f"'{name}={entry}'" for name, entry in new_values.items())
            except Exception:  # the value does not fit the old setting either
                entries = ""
            raise UserError(f"'{path}={value}' is now {entries}" if entries else f"'{path}' is not a setting any more")
