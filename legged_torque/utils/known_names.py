"""Classes and functions that settings name: what no registered task names is refused before it is imported.

Settings may be a stranger's, in the ``config.yaml`` of a run or the description of an experiment, and importing or
calling what they name would run any code that is installed. What a user's own task registers is known.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from legged_torque.utils.config import BaseConfig, flat, to_dict
from legged_torque.utils.errors import UserError, unknown_name

NAMING = ("class_name", "function", "_func")
"""Ends of the names of settings that name a class or a function."""


def check_names(train_cfg: BaseConfig, registered: Iterable[Any]) -> None:
    """Refuse, by UserError, what training settings name but none of the ``registered`` ones nor their presets do."""
    unknown, known = named(to_dict(train_cfg)), dict[str, list[Any]]()
    for cfg in registered:
        if not unknown:  # with tasks of the package, after the first ones: there are many
            return
        for settings in (to_dict(cfg), *cfg.presets().values()):
            for path, name in named(settings):
                known.setdefault(path, []).append(name)
        unknown = [(path, name) for path, name in unknown if name not in known.get(path, [])]
    for path, name in unknown:
        error = unknown_name(path, str(name), {str(other) for other in known.get(path, []) if other})
        raise UserError(f"{error}; these are the names that registered tasks have, register a task to add one")


def import_names(train_cfg: BaseConfig) -> None:
    """Import what training settings name; a UserError says what cannot be."""
    from rsl_rl.utils import resolve_callable  # takes seconds: first :func:`check_names` tells mistakes without it

    for path, name in named(to_dict(train_cfg)):
        try:
            if name:
                resolve_callable(name)
        except (ValueError, ImportError, AttributeError) as error:
            raise UserError(f"{path}: {error}") from None


def named(settings: dict[str, Any]) -> list[tuple[str, Any]]:
    """Return dotted path and value of every setting that names a class or a function, at any depth."""
    return [(path, name) for path, name in flat(settings).items() if path.endswith(NAMING)]
