"""Methods of task classes: those that are never called, such as legged_gym's hooks, and terms of a wrong shape."""

import difflib
import inspect
from collections.abc import Iterator
from types import CodeType
from typing import Any

import torch
from torch import Tensor

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.utils.buffers import check_tensor
from legged_torque.utils.config import flat, section_keys, successor
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


def check_terms(task: Any) -> None:
    """Raise a UserError unless torques, rewards and terminations of a task have the shapes and types that steps need.

    What a step calls of a user's is called once; what it wrote into tensors of the task and the motors is undone.
    """
    tensors = [value for value in vars(task).values() if isinstance(value, Tensor)]
    tensors += flat(task.motors.state_dict()).values()
    before = [tensor.clone() for tensor in tensors]
    pos, vel = task.dof_pos, task.dof_vel
    if task.computes_in_torch():
        wanted = task._compute_torques(task.motors.actions(pos, vel, 0))
        check_tensor(f"what {type(task).__name__}._compute_torques returns", wanted, pos.shape, pos.device)
        task.motors.apply(wanted, pos, vel, 0)
    task._post_physics_step_callback()
    for name, is_over in task.terminations.items():
        check_tensor(f"termination '{name}'", is_over(), (task.num_envs,), task.device, torch.bool)
    for name, function in task.rewards.functions.items():
        check_tensor(f"reward term '{name}'", function(), (task.num_envs,), task.device)
    for tensor, copy in zip(tensors, before, strict=True):
        if not torch.equal(tensor, copy):
            tensor.copy_(copy)


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
