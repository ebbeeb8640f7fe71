"""Configuration classes in legged_gym's style; dictionaries and dotted paths to read and change them."""

import contextlib
import copy
import functools
import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import yaml

from legged_torque.utils.errors import UserError, collect_errors, refuse, unknown_name
from legged_torque.utils.limits import check_value, types_of
from legged_torque.utils.plain_yaml import parse_yaml

DECLARE = "to declare new ones, annotate a setting (name: float = ...), derive a section from Section"


class Section:
    """A part of a configuration: its settings are class attributes, its sections are nested classes.

    Nested classes inherit by themselves. ``class control: stiffness = 30.0`` in a subclass takes all other settings of
    ``control`` from the sections of that name in the base classes, in Python's method resolution order. Naming a base,
    as in ``class control(A1Cfg.control):``, is allowed; it matters only if it is a section of another configuration.

    A name that no base class has is a mistake, unless the class declares it new: a setting by an annotation
    (``ramp_time: float = 2.0``), a section by its base (``class ramp(Section):``). :class:`BaseConfig` refuses all
    mistakes of a configuration at once.

    An instance has instances in place of all nested classes, and copies of lists and dictionaries, so that changing it
    never changes its class.
    """

    _mistakes: ClassVar[dict[str, str]] = {}
    """What is wrong with names of this class and of its sections, by dotted path."""
    _names: ClassVar[list[str]] = []
    """Names of settings and sections when the class was made: found once, as each start makes hundreds of instances."""

    def __init_subclass__(cls) -> None:
        """Keep mistakes in the names of a new class, and let its nested classes inherit."""
        super().__init_subclass__()
        cls._mistakes = {path: text for base in cls.__bases__ for path, text in getattr(base, "_mistakes", {}).items()}
        cls._mistakes |= _find_mistakes(cls)
        cls._names = _entries(cls)
        for name in cls._names:
            if not inspect.isclass(getattr(cls, name)):
                continue
            values = (getattr(owner, name, None) for owner in (cls, *cls.__bases__))
            found = dict.fromkeys(filter(inspect.isclass, values))
            parts: list[Any] = [part for part in found if not any(o is not part and issubclass(o, part) for o in found)]
            if len(parts) > 1 or not issubclass(parts[0], Section):
                bases = parts if any(issubclass(part, Section) for part in parts) else [*parts, Section]
                names = {"__qualname__": f"{cls.__qualname__}.{name}", "__module__": cls.__module__}
                parts = [type(name, tuple(bases), names)]
            setattr(cls, name, parts[0])
            cls._mistakes |= {f"{name}.{path}": text for path, text in parts[0]._mistakes.items()}

    def __init__(self) -> None:
        """Instantiate the nested sections, all the way down."""
        for key in self._names:
            value = getattr(self, key)
            if inspect.isclass(value):
                value = value()
            elif isinstance(value, (list, tuple, dict)):
                value = copy.deepcopy(list(value) if isinstance(value, tuple) else value)  # YAML knows no tuples
            setattr(self, key, value)

    if not TYPE_CHECKING:  # which would then take any name for a setting

        def __getattr__(self, name: str) -> Any:
            """Refuse legged_gym's settings with their successors; Python calls this for what does not exist."""
            if not name.startswith("_") and (replaced := successor("settings", f"{type(self).__name__}.{name}")):
                raise UserError(replaced)
            raise AttributeError(f"'{type(self).__name__}' has no setting or section '{name}'")

    def check(self, path: str = "") -> None:
        """Raise a UserError that names all settings, here and below, that the class lacks or whose values are wrong.

        ``path`` is where the section stands in its configuration.
        """
        problems, advice = list[str](), ""
        for key in section_keys(self):
            value, dotted = getattr(self, key), f"{path}.{key}" if path else key
            with collect_errors(problems):
                if isinstance(value, Section):  # which may be new, as in a class
                    value.check(dotted)
                else:
                    advice = advice if key in self._names else DECLARE
                    plain = check_value(checked_path(path, key, self._names), value, _type_of(self, key))
                    setattr(self, key, plain)  # numpy's numbers are floats to Python, but not to YAML
        refuse(problems, advice=advice)


def _is_entry(name: str, value: Any) -> bool:
    """Return whether an attribute of a class is a setting or a section."""
    return not name.startswith("_") and not inspect.isroutine(value)


def _entries(owner: type) -> list[str]:
    """Return the names of all settings and sections of a class, inherited ones included and first."""
    found = [(name, value) for base in reversed(owner.__mro__[:-1]) for name, value in vars(base).items()]
    return list(dict.fromkeys(name for name, value in found if _is_entry(name, value)))


def _find_mistakes(cls: type[Section]) -> dict[str, str]:
    """Return mistakes in names of a class, and of its bases that are no sections yet; kinds of entries stay right."""
    where, mistakes = cls.__qualname__.rpartition("<locals>.")[2], dict[str, str]()
    for owner in (cls, *(base for base in cls.__bases__ if not issubclass(base, Section))):
        own = {name: value for name, value in vars(owner).items() if _is_entry(name, value)}
        sections = [base for base in cls.__bases__ if issubclass(base, Section)] if own else []
        known = [name for section in sections for name in _entries(section)]
        annotated = inspect.get_annotations(owner)
        for name, value in own.items():
            declared_new = name in annotated or (inspect.isclass(value) and issubclass(value, Section))
            if known and name not in known and not declared_new:
                mistakes[name] = str(unknown_name(f"setting or section of {where}", name, known))
            for section in sections:
                inherited = getattr(section, name, value)
                if inspect.isclass(inherited) != inspect.isclass(value):
                    kinds = ("a setting", "a section") if inspect.isclass(value) else ("a section", "a setting")
                    mistakes[name] = f"{where}.{name} is {kinds[1]}, but in {section.__qualname__} it is {kinds[0]}"
                    setattr(cls, name, inherited)
    return mistakes


class BaseConfig(Section):
    """A whole configuration."""

    @classmethod
    def refuse_mistakes(cls, *others: "type[BaseConfig]") -> None:
        """Raise a UserError that names all mistakes in names of settings, also those of other configurations.

        legged_gym's names have their successors, others the nearest names.
        """
        mistakes = {path: text for part in (cls, *others) for path, text in part._mistakes.items()}
        refuse([successor("settings", path) or text for path, text in mistakes.items()], advice=DECLARE)

    def check(self, path: str = "") -> None:
        """Refuse mistakes in the classes' names, then in the instances' names and values, by UserError."""
        self.refuse_mistakes()
        super().check(path)

    def upgraded(self, values: dict[str, Any]) -> dict[str, Any]:
        """Return the settings of an earlier run, as nested dictionaries, in today's layout."""
        return values


@functools.cache
def successors(kind: Literal["settings", "methods", "attributes"]) -> dict[str, str]:
    """Return the replacements, in words, of names of legged_gym and of earlier versions; settings are dotted paths."""
    return yaml.safe_load(Path(__file__).with_name("successors.yaml").read_text("utf-8"))[kind]


def successor(kind: Literal["settings", "methods", "attributes"], name: str) -> str:
    """Return a sentence with the replacement of a name; empty for names that never existed."""
    new = successors(kind).get(name)
    return f"'{name}' is now {new}" if new else ""


def section_keys(section: Any) -> list[str]:
    """Return the names of a section's entries, inherited ones included, in the order of their definition."""
    return [name for name in vars(section) if not name.startswith("_")]


def to_dict(section: Any) -> dict[str, Any]:
    """Return a configuration as nested dictionaries of plain values."""
    values = ((key, getattr(section, key)) for key in section_keys(section))
    return {key: to_dict(value) if isinstance(value, Section) else value for key, value in values}


def flat(values: Any, path: str = "") -> dict[str, Any]:
    """Return nested dictionaries, which stand at ``path``, as one dictionary with dotted paths."""
    if not isinstance(values, dict):
        return {path: values}
    parts = (flat(value, f"{path}.{key}" if path else str(key)) for key, value in values.items())
    return {name: value for part in parts for name, value in part.items()}


def _type_of(section: Section, key: str) -> Any:
    """Return the declared type of a setting; that of its value if a class of its own has declared none."""
    owner: type = type(section)
    return types_of(owner).get(key, type(getattr(section, key)))


def update_from_dict(section: Any, values: dict[str, Any], path: str = "") -> None:
    """Write nested dictionaries into a ``section`` at ``path``; a UserError names what does not fit."""
    if not isinstance(values, dict):
        raise UserError(f"config key '{path}' is a section with entries, it cannot be the value {values!r}")
    for key, value in values.items():
        _set(section, [str(key)], value, path)


def set_by_path(section: Any, dotted_path: str, value: Any) -> None:
    """Set one entry, e.g. ``set_by_path(cfg, "rewards.scales.torques", -1e-4)``.

    Text is read as YAML, unless the setting allows the text itself. A UserError names an entry that does not exist, or
    what its values must be.
    """
    _set(section, dotted_path.split("."), value, "")


def _set(section: Any, keys: list[str], value: Any, path: str) -> None:
    """Set the entry below ``section``, which is at ``path``, that ``keys`` lead to."""
    (key, *rest), dotted = keys, checked_path(path, keys[0], section_keys(section))
    old, hint = getattr(section, key), _type_of(section, key)
    if isinstance(old, Section):
        _set(old, rest, value, dotted) if rest else update_from_dict(old, value, dotted)
        return
    if rest and (rest[1:] or not isinstance(old, dict)):
        raise UserError(f"config key '{dotted}' is a value, it has no entry '{'.'.join(rest)}'")
    for entry in rest:  # at most one, of a dictionary
        checked_path(dotted, entry, list(old))
    if isinstance(value, str):
        with contextlib.suppress(UserError):  # of a text that is no value itself
            setattr(section, key, check_value(dotted, {**old, rest[0]: value} if rest else value, hint))
            return
        value = parse_yaml(value, f"the value '{value}'")
    setattr(section, key, check_value(dotted, {**old, rest[0]: value} if rest else value, hint))


def checked_path(path: str, key: str, names: list[str]) -> str:
    """Return the dotted path of the entry ``key`` at ``path``; a UserError if it is not one of the names."""
    prefix = f"{path}." if path else ""
    if key not in names:
        if replaced := successor("settings", f"{prefix}{key}"):
            raise UserError(replaced)
        raise unknown_name("config key", f"{prefix}{key}", [f"{prefix}{name}" for name in names])
    return f"{prefix}{key}"
