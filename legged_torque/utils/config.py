"""Configuration classes in legged_gym's style, and plain dictionaries and dotted paths to read and change them."""

from __future__ import annotations

import copy
import inspect
from typing import Any

import yaml

from legged_torque.utils.errors import UserError, unknown_name


class BaseConfig:
    """A configuration whose sections are nested classes.

    A subclass overrides what it wants to change and inherits the rest. Creating one turns every nested class into an
    object of its own and copies lists and dictionaries, so that changing a configuration never changes its class.
    """

    def __init__(self) -> None:
        """Instantiate all nested sections."""
        instantiate_sections(self)


def instantiate_sections(section: Any) -> None:
    """Replace the nested classes of ``section`` by instances of them, all the way down."""
    for key in section_keys(section):
        value = getattr(section, key)
        if inspect.isclass(value):
            value = value()
            if not isinstance(value, BaseConfig):
                instantiate_sections(value)
        elif isinstance(value, (list, tuple, dict)):
            value = copy.deepcopy(list(value) if isinstance(value, tuple) else value)  # YAML knows no tuples
        setattr(section, key, value)


def section_keys(section: Any) -> list[str]:
    """Return the names of a section's entries, inherited ones included, in the order of their definition."""
    classes = reversed(type(section).__mro__[:-1])
    keys = dict.fromkeys(key for cls in classes for key in vars(cls))
    keys.update(dict.fromkeys(vars(section)))
    return [key for key in keys if not key.startswith("_") and not inspect.isroutine(getattr(section, key))]


def is_section(value: Any) -> bool:
    """Return whether a configuration entry holds entries of its own."""
    return hasattr(value, "__dict__") and not inspect.isroutine(value)


def to_dict(section: Any) -> dict[str, Any]:
    """Return a configuration as nested dictionaries of plain values."""
    result = {}
    for key in section_keys(section):
        value = getattr(section, key)
        result[key] = to_dict(value) if is_section(value) else value
    return result


def update_from_dict(section: Any, values: dict[str, Any], path: str = "") -> None:
    """Write nested dictionaries of values into a configuration.

    Args:
        section: The configuration, changed in place.
        values: What to write; every key must exist.
        path: Dotted path of ``section``, for messages.

    Raises:
        UserError: If a key does not exist or a value has the wrong type.
    """
    if not isinstance(values, dict):
        raise UserError(f"config key '{path}' is a section with entries, it cannot be the value {values!r}")
    for key, value in values.items():
        set_entry(section, [str(key)], value, path)


def set_by_path(section: Any, dotted_path: str, value: Any) -> None:
    """Set one entry, e.g. ``set_by_path(cfg, "rewards.scales.torques", -1e-4)``.

    Raises:
        UserError: If the path does not exist or the value has the wrong type.
    """
    set_entry(section, dotted_path.split("."), value, "")


def set_entry(section: Any, keys: list[str], value: Any, path: str) -> None:
    """Set the entry below ``section`` that ``keys`` lead to; ``path`` is where ``section`` itself stands."""
    key, rest = keys[0], keys[1:]
    dotted = f"{path}.{key}" if path else key
    is_dict = isinstance(section, dict)
    allowed = list(section) if is_dict else section_keys(section)
    if key not in allowed:
        raise unknown_name("config key", dotted, [f"{path}.{name}" if path else name for name in allowed])
    old = section[key] if is_dict else getattr(section, key)
    if rest:
        if not is_section(old) and not isinstance(old, dict):
            raise UserError(f"config key '{dotted}' is a value, it has no entry '{'.'.join(rest)}'")
        set_entry(old, rest, value, dotted)
    elif is_section(old):
        update_from_dict(old, value, dotted)
    else:
        new = convert(value, old, dotted)
        if is_dict:
            section[key] = new
        else:
            setattr(section, key, new)


def convert(value: Any, old: Any, path: str) -> Any:
    """Return ``value`` in the type of ``old``, the entry that it replaces.

    Raises:
        UserError: If that is not possible.
    """
    if isinstance(value, str) and not isinstance(old, str):
        value = parse_value(value)
    if old is None:
        return value
    if isinstance(old, bool) or isinstance(value, bool):
        matches = isinstance(old, bool) and isinstance(value, bool)
    elif isinstance(old, float) and isinstance(value, int):
        return float(value)
    elif isinstance(old, int) and isinstance(value, float):
        matches = value.is_integer()
        value = int(value) if matches else value
    else:
        matches = isinstance(value, type(old))
    if matches and isinstance(old, list) and old and len({type(item) for item in old}) == 1:
        value = [convert(item, old[0], f"{path}[{i}]") for i, item in enumerate(value)]
    if not matches:
        raise UserError(f"config key '{path}' takes a value like {old!r}, not {value!r}")
    return value


def parse_value(text: str) -> Any:
    """Return the value that a piece of text stands for, as YAML reads it, and also read ``1e-4`` as a number.

    Raises:
        UserError: If the text is not valid YAML.
    """
    if "e" in text.lower():  # PyYAML reads 1e-4 as text, since it has no dot
        try:
            return float(text)
        except ValueError:
            pass
    return parse_yaml(text, f"the value '{text}'")


def parse_yaml(text: str, what: str) -> Any:
    """Return what YAML text holds.

    Args:
        text: The YAML text.
        what: What the text is, for the message.

    Raises:
        UserError: If the text is not valid YAML.
    """
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:  # a date such as 2026-99-99 is a ValueError
        raise UserError(f"{what} is not valid YAML: {' '.join(str(error).split())}") from None
