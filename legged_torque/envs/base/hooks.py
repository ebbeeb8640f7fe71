"""Methods of task classes that nothing would ever call: legged_gym's hooks, misspelt ones, terms without a setting."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Collection, Iterator, Mapping

from legged_torque.utils.legged_gym import successor

SIMILAR = 0.88  # share of letters from which on a method seems to be a misspelt hook


def idle_methods(task: type, base: type, terms: Mapping[str, tuple[str, Collection[str]]]) -> Iterator[str]:
    """Yield the methods that a task class adds to its ``base``, or overrides, to no effect, and what to do instead.

    Args:
        task: The class.
        base: The class of which all hooks are known.
        terms: By beginning of the names of terms: the section with their settings, and the settings' names.
    """
    hooks = [name for name in dir(base) if inspect.isroutine(getattr(base, name))]
    for owner in task.__mro__:
        own = {} if issubclass(base, owner) else vars(owner)
        for name in (name for name, value in own.items() if inspect.isroutine(value) and not name.startswith("__")):
            near = difflib.get_close_matches(name, hooks, 1, SIMILAR)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            beginning = next(filter(name.startswith, terms), "")
            section, settings = terms.get(beginning, ("", ()))
            replaced = successor("methods", name)
            if replaced:
                yield f"{owner.__name__}: {replaced}"
            elif beginning and name.removeprefix(beginning) not in settings:
                wanted = f"{section}.{name.removeprefix(beginning)}"
                yield f"{owner.__name__}.{name} is never called, since there is no setting {wanted}{hint}"
            elif near and not beginning and name not in hooks:
                yield f"{owner.__name__}.{name} is never called{hint}"
