"""Configuration classes in legged_gym's style, and plain dictionaries and dotted paths to read and change them."""

from __future__ import annotations

import copy
import inspect
import itertools
import re
from typing import Any

import yaml

from legged_torque.utils.errors import UserError, unknown_name

MAX_LENGTH, MAX_DEPTH, MAX_ENTRIES = 1_000_000, 50, 100_000
"""Characters and levels of a YAML text, and values of a level; settings have about 10 000, 6 and 100."""


class Section:
    """A part of a configuration: its settings are class attributes, its sections are nested classes.

    Nested classes inherit by themselves. ``class control: stiffness = 30.0`` in a subclass takes all other settings of
    ``control`` from the sections of that name in the base classes, in Python's method resolution order. Naming a base,
    as in ``class control(A1Cfg.control):``, is allowed; it matters only if it is a section of another configuration.

    A name that no base class has is refused when the class is made, unless the class declares it new: a setting by an
    annotation (``ramp_time: float = 2.0``), a section by its base (``class ramp(Section):``).

    An instance has instances in place of all nested classes, and copies of lists and dictionaries, so that changing it
    never changes its class.
    """

    def __init_subclass__(cls) -> None:
        """Refuse unknown names of a new class with a UserError, and let its nested classes inherit."""
        super().__init_subclass__()
        _check_names(cls)
        names = [name for owner in reversed(cls.__mro__) for name in vars(owner)]
        for name in dict.fromkeys(names):
            if not name.startswith("_") and inspect.isclass(getattr(cls, name)):
                merged = _merge(cls, name)
                if merged is not getattr(cls, name):
                    setattr(cls, name, merged)

    def __init__(self) -> None:
        """Instantiate the nested sections, all the way down."""
        for key in section_keys(self):
            value = getattr(self, key)
            if inspect.isclass(value):
                value = value()
            elif isinstance(value, (list, tuple, dict)):
                value = copy.deepcopy(list(value) if isinstance(value, tuple) else value)  # YAML knows no tuples
            setattr(self, key, value)


def section_names(section: type) -> list[str]:
    """Return the names of the settings and sections of a class; methods are neither."""
    return [name for name in dir(section) if not name.startswith("_") and not inspect.isroutine(getattr(section, name))]


def _check_names(cls: type[Section]) -> None:
    """Refuse names of a class that no base class has and that it does not declare new."""
    known = [name for base in cls.__bases__ for name in section_names(base)]
    annotated = inspect.get_annotations(cls)
    where = cls.__qualname__.rpartition("<locals>.")[2]
    for name, value in vars(cls).items():
        if name.startswith("_") or inspect.isroutine(value):
            continue
        declared_new = name in annotated or (inspect.isclass(value) and issubclass(value, Section))
        if known and name not in known and not declared_new:
            raise UserError(
                f"{unknown_name(f'setting or section of {where}', name, known)}; to declare it new, annotate a setting "
                f"({name}: float = ...), derive a section from Section"
            )
        for base in cls.__bases__:
            if inspect.isclass(getattr(base, name, value)) != inspect.isclass(value):
                kinds = ("a setting", "a section") if inspect.isclass(value) else ("a section", "a setting")
                raise UserError(f"{where}.{name} is {kinds[1]}, but in {base.__qualname__} it is {kinds[0]}")


def _merge(cls: type[Section], name: str) -> type[Section]:
    """Return the nested class ``name`` of ``cls``; its bases are the sections of that name in all bases of ``cls``."""
    own = vars(cls).get(name)
    inherited = [getattr(base, name) for base in cls.__bases__ if hasattr(base, name)]
    named = [] if own is None else [base for base in own.__bases__ if base not in (object, Section)]
    # What it names as bases itself comes first, unless it is among theirs anyway.
    foreign = [base for base in named if not any(issubclass(section, base) for section in inherited)]
    bases = list(dict.fromkeys([*foreign, *inherited])) or [Section]
    bases = [base for base in bases if not any(other is not base and issubclass(other, base) for other in bases)]
    if own is None and len(bases) == 1:
        return bases[0]
    of_every_class = ("__dict__", "__weakref__")  # Python adds them by itself
    members = {} if own is None else {key: value for key, value in vars(own).items() if key not in of_every_class}
    members["__qualname__"] = f"{cls.__qualname__}.{name}"
    return type(name, tuple(bases), members)


class BaseConfig(Section):
    """A whole configuration: settings in sections, and nothing but sections on top."""

    def upgraded(self, values: dict[str, Any]) -> dict[str, Any]:
        """Return the settings of an older run, as nested dictionaries, in today's layout."""
        return values


def section_keys(section: Any) -> list[str]:
    """Return the names of a section's entries, inherited ones included, in the order of their definition."""
    classes = reversed(type(section).__mro__[:-1])
    keys = dict.fromkeys(key for cls in classes for key in vars(cls))
    keys.update(dict.fromkeys(vars(section)))
    return [key for key in keys if not key.startswith("_") and not inspect.isroutine(getattr(section, key))]


def to_dict(section: Any) -> dict[str, Any]:
    """Return a configuration as nested dictionaries of plain values."""
    values = {key: getattr(section, key) for key in section_keys(section)}
    return {key: to_dict(value) if isinstance(value, Section) else value for key, value in values.items()}


def flat(values: Any, path: str = "") -> dict[str, Any]:
    """Return nested dictionaries, which stand at ``path``, as one dictionary with dotted paths."""
    if not isinstance(values, dict):
        return {path: values}
    parts = (flat(value, f"{path}.{key}" if path else str(key)) for key, value in values.items())
    return {name: value for part in parts for name, value in part.items()}


def update_from_dict(section: Any, values: dict[str, Any], path: str = "") -> None:
    """Write nested dictionaries into a ``section``, which stands at ``path``; what does not fit is a UserError."""
    if not isinstance(values, dict):
        raise UserError(f"config key '{path}' is a section with entries, it cannot be the value {values!r}")
    for key, value in values.items():
        set_entry(section, [str(key)], value, path)


def set_by_path(section: Any, dotted_path: str, value: Any) -> None:
    """Set one entry, e.g. ``set_by_path(cfg, "rewards.scales.torques", -1e-4)``; errors as of update_from_dict."""
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
        if not isinstance(old, (Section, dict)):
            raise UserError(f"config key '{dotted}' is a value, it has no entry '{'.'.join(rest)}'")
        set_entry(old, rest, value, dotted)
    elif isinstance(old, Section):
        update_from_dict(old, value, dotted)
    else:
        new = convert(value, old, dotted)
        if is_dict:
            section[key] = new
        else:
            setattr(section, key, new)


def convert(value: Any, old: Any, path: str) -> Any:
    """Return ``value`` in the type of ``old``, the entry that it replaces; a UserError if that is not possible."""
    if isinstance(value, str) and not isinstance(old, str):
        value = parse_value(value)
    if old is None or value is None:  # whether it may be null, its type says: see check_section
        return value
    if isinstance(old, bool) or isinstance(value, bool):
        matches = isinstance(old, bool) and isinstance(value, bool)
    elif isinstance(old, float) and isinstance(value, int):
        return float(str(value))  # too large a number is infinite, not an error
    elif isinstance(old, int) and isinstance(value, float):
        matches = value.is_integer()
        value = int(value) if matches else value
    else:
        matches = isinstance(value, type(old))
    if matches and isinstance(old, list) and old and len({type(item) for item in old}) == 1:
        value = [convert(item, old[0], f"{path}[{i}]") for i, item in enumerate(value)]
    if matches and isinstance(old, dict) and len({type(item) for item in old.values()}) == 1:
        value = {key: convert(item, next(iter(old.values())), f"{path}.{key}") for key, item in value.items()}
    if not matches:
        raise UserError(f"config key '{path}' takes a value like {old!r}, not {value!r}")
    return value


def parse_value(text: str) -> Any:
    """Return the value that a piece of text stands for, see :func:`parse_yaml`."""
    return parse_yaml(text, f"the value '{text}'")


def parse_yaml(text: str, what: str) -> Any:
    """Return what YAML text holds, see :class:`Loader`; a UserError says ``what`` is no YAML or too large."""
    try:
        if len(text) <= MAX_LENGTH and is_small(value := yaml.load(text, Loader)):
            return value
    except (yaml.YAMLError, ValueError) as error:  # a whole number of 5000 digits is a ValueError
        raise UserError(f"{what} is not valid YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        pass
    raise UserError(f"{what} is nested too deeply or larger than settings are")


def is_small(value: Any) -> bool:
    """Return whether nested lists and dictionaries have at most :data:`MAX_DEPTH` levels of :data:`MAX_ENTRIES` each.

    YAML may name a part again and again, even inside of itself, so that a short text holds more than memory does. Whole
    numbers must be small enough for a float.
    """
    level = [value]
    for _ in range(MAX_DEPTH):
        if any(isinstance(part, int) and part.bit_length() > 1000 for part in level):
            return False
        parts = (part.values() if isinstance(part, dict) else part for part in level if isinstance(part, (dict, list)))
        level = list(itertools.islice(itertools.chain.from_iterable(parts), MAX_ENTRIES + 1))
        if not level or len(level) > MAX_ENTRIES:
            return not level
    return False


class Loader(yaml.SafeLoader):
    """Reads words as YAML 1.2 does: 017 is seventeen and 1e-4 a number; 1:30, on, yes and dates are text."""


class Dumper(yaml.SafeDumper):
    """Writes what :class:`Loader` reads again: text that looks like one of its numbers is quoted."""


Loader.yaml_implicit_resolvers = {}  # none of YAML 1.1
for _tag, _pattern in {
    "null": r"~|null|Null|NULL|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?[0-9]+",
    "float": r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
}.items():
    for _class in (Loader, Dumper):
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), None)
Loader.add_constructor("tag:yaml.org,2002:int", lambda _, node: int(node.value))
