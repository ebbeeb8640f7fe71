"""YAML of strangers: plain values of ordinary size, with words and numbers as YAML 1.2 reads them."""

import itertools
import re
from typing import Any

import yaml

from legged_torque.utils.errors import UserError

MAX_LENGTH, MAX_DEPTH, MAX_ENTRIES = 1_000_000, 50, 100_000
"""Characters and levels of a text, and values of a level; settings have about 10 000, 6 and 100."""


def parse_yaml(text: str, source: str) -> Any:
    """Return the content of a YAML text; a UserError names its ``source`` if it is invalid or too large."""
    try:
        if len(text) <= MAX_LENGTH and is_small(value := yaml.load(text, Loader)):
            return value
    except (yaml.YAMLError, ValueError) as error:  # a whole number of 5000 digits is a ValueError
        raise UserError(f"{source} is not valid YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        pass
    raise UserError(f"{source} is nested too deeply or larger than settings are")


def dump_yaml(value: Any, **how: Any) -> str:
    """Return a value as YAML that :func:`parse_yaml` reads the same; ``how`` is for PyYAML."""
    return yaml.dump(value, Dumper=Dumper, sort_keys=False, **how)


def is_small(value: Any) -> bool:
    """Return whether nested lists and dictionaries have at most :data:`MAX_DEPTH` levels of :data:`MAX_ENTRIES` each.

    An alias may repeat a part many times, even inside itself, so that a short text expands beyond all memory. Integers
    must fit into a float.
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

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Leave merge keys, ``!!merge``, unread: merges of merges grow without bounds while the text is loaded."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the values of a mapping; a YAMLError if a key stands in it twice, of which YAML keeps the last one."""
        values = super().construct_mapping(node, deep)
        if len(values) < len(node.value):
            for key_node, _ in node.value:
                if (key := self.construct_object(key_node, deep=True)) not in values:
                    raise yaml.YAMLError(f"line {key_node.start_mark.line + 1} has the key {key!r} a second time")
                del values[key]
        return values


class Dumper(yaml.SafeDumper):
    """Writes YAML for :class:`Loader`: text that looks like one of its numbers is quoted."""


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
