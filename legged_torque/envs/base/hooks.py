"""Methods of task classes that are never called: legged_gym's hooks, misspelt hooks, terms without a setting."""

import difflib
import inspect
from collections.abc import Iterator
from types import CodeType

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.utils.config import section_keys, successor
from legged_torque.utils.errors import refuse

SIMILAR = 0.88  # share of letters from which on a method seems to be a misspelt hook


def check_methods(task: type, base: type, cfg: LeggedRobotCfg) -> None:
    """Raise a UserError that names all methods of a task class that are never called, and their replacements.

    ``base`` is the class of which all hooks are known; the settings decide which terms are in use.
    """
    terms = {"_reward_": ("rewards.scales", section_keys(cfg.rewards.scales))}
    terms["_termination_"] = ("terminations", section_keys(cfg.terminations))
    owners = [owner for owner in task.__mro__ if not issubclass(base, owner)]
    methods = [(name, _code(value)) for owner in owners for name, value in vars(owner).items()]
    used = {used for name, code in methods if code for used in _names(code) if used != name}
    refuse([problem for owner in owners for problem in _idle(owner, base, terms, used)])


def _code(value: object) -> CodeType | None:
    """Return the code of a method, a property or the like; None of anything else."""
    for name in ("fget", "func", "__func__"):
        value = getattr(value, name, value)
    return getattr(inspect.unwrap(value), "__code__", None)  # type: ignore[arg-type]


def _names(code: CodeType) -> Iterator[str]:
    """Yield the names that code and what is defined in it refer to."""
    yield from code.co_names
    for part in code.co_consts:
        yield from _names(part) if isinstance(part, CodeType) else ()


def _idle(owner: type, base: type, terms: dict[str, tuple[str, list[str]]], used: set[str]) -> Iterator[str]:
    """Yield such methods of a class; those whose names are ``used`` in others are helpers, and left out.

    ``terms`` are section and names of settings by the beginning of methods.
    """
    hooks = [name for name in dir(base) if inspect.isroutine(getattr(base, name))]
    for name in (name for name, value in vars(owner).items() if inspect.isroutine(value) and not name.startswith("__")):
        beginning = next(filter(name.startswith, terms), "")
        section, settings = terms.get(beginning, ("", []))
        term, near = name.removeprefix(beginning), difflib.get_close_matches(name, hooks, 1, SIMILAR)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        if replaced := successor("methods", name):
            yield f"{owner.__name__}: {replaced}"
        elif name in used:
            continue
        elif beginning and term not in settings:
            yield f"{owner.__name__}.{name} is never called: there is no setting {section}.{term}{hint}"
        elif near and not beginning and name not in hooks:
            yield f"{owner.__name__}.{name} is never called{hint}"
