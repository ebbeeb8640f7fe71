"""Policies that were made by supervision before reinforcement learning: their files, and trainings that start from one.

A file holds the policy's network and the settings that decide what its inputs and outputs mean, so that it is used
again wherever these are the same, and refused where they are not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rsl_rl.utils import resolve_callable
from torch import Tensor

from legged_torque.learning import checkpoint
from legged_torque.learning.runner import OnPolicyRunner
from legged_torque.utils.cli import check_output
from legged_torque.utils.config import flat, to_dict
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import held
from legged_torque.utils.task_registry import all_experiments_dir

SPACES = {
    "env": (
        "asset.file",
        "init_state.default_joint_angles",
        "env.history_length",
        "sim.dt",
        "control",
        "normalization",
    ),
    "train": (
        "actor.class_name",
        "actor.hidden_dims",
        "actor.head_hidden_dims",
        "actor.activation",
        "obs_groups.actor",
    ),
}
"""Settings of task and training, if they have them, in which a pre-trained policy must agree: what it sees and does."""
OF_TRAINING = ("file", "critic_warmup_iterations")
"""Settings of ``pretraining`` that say how a training starts from a policy, not how the policy is made."""
PRETRAINED = "pretrained"  # folder of pre-trained policies, in that of all experiments
STANDARD_DEVIATION = "distribution."
"""Start of the names of parameters that are not taken over: how much a training explores is its own setting."""


def pretrained_file(task: str, train_cfg: Any, log_root: str | None = None) -> Path:
    """Return where a task's pre-trained policy is kept: ``pretraining.file``, or in the folder of all experiments."""
    if train_cfg.pretraining.file:
        return Path(train_cfg.pretraining.file)
    return all_experiments_dir(log_root) / PRETRAINED / f"{task}.pt"


def find_pretrained(file: Path, task: str, env_cfg: Any, train_cfg: Any, device: str) -> None:
    """Make a task's pre-trained policy if its file is missing; a UserError if the file's does not fit the task.

    A policy that was made with other settings of ``pretraining`` does not fit: it may not even stand. Of trainings that
    start at the same time one makes the policy, and the others wait.
    """
    if not file.exists():
        check_output(file)
        with held(file.with_name(f"{file.name}.lock")):
            if not file.exists():
                print(f"There is no pre-trained policy '{file}' yet; making it.", flush=True)
                make_pretrained(file, task, env_cfg, train_cfg, device)
    check_spaces(file, env_cfg, train_cfg)
    check_making(file, train_cfg)
    print(f"Starting from the pre-trained policy '{file}'.")


def make_pretrained(file: Path, task: str, env_cfg: Any, train_cfg: Any, device: str) -> dict[str, Any]:
    """Make a task's pre-trained policy, and return what its making reports; a UserError if it has no pre-training."""
    if not train_cfg.pretraining.function:
        raise UserError(f"task '{task}' has no pre-training: its pretraining.function is empty")
    check_output(file)
    actor, report = resolve_callable(train_cfg.pretraining.function)(task, env_cfg, train_cfg, device)
    content = {"actor_state_dict": actor.state_dict(), "spaces": spaces(env_cfg, train_cfg), "report": report}
    checkpoint.write(file, content)
    return report


def start_from(runner: OnPolicyRunner, file: Path) -> None:
    """Give the actor of a runner the network of a pre-trained policy, all but its standard deviation.

    A UserError names the first parameter that the two do not have in the same shape, or that is not finite; then the
    actor is as it was.
    """
    actor = runner.alg.policy()
    state, pretrained = actor.state_dict(), read_pretrained(file)["actor_state_dict"]
    for name in dict.fromkeys((*state, *map(str, pretrained))):
        if not name.startswith(STANDARD_DEVIATION):
            old, new = state.get(name), pretrained.get(name)
            if old is None or not isinstance(new, Tensor) or new.shape != old.shape or not new.isfinite().all():
                why = f"its parameter '{name}' is missing, not of the actor's shape or not finite"
                raise UserError(f"the pre-trained policy '{file}' does not fit this task: {why}")
            state[name] = new
    actor.load_state_dict(state)


def check_spaces(file: Path, env_cfg: Any, train_cfg: Any) -> None:
    """Refuse a pre-trained policy whose inputs, outputs or network are not those of a task, naming what differs."""
    of_file = read_pretrained(file)["spaces"]
    for name, value in spaces(env_cfg, train_cfg).items():
        if name in of_file and repr(of_file[name]) != repr(value):  # files of older versions lack the nominal pose
            raise UserError(
                f"the pre-trained policy '{file}' does not fit this task: its {name} is {of_file[name]!r}, here it "
                f"is {value!r}; make another one in a file of its own: --set pretraining.file=FILE"
            )


def check_making(file: Path, train_cfg: Any) -> None:
    """Refuse a pre-trained policy that was made with other settings of ``pretraining``, naming the first one."""
    settings = read_pretrained(file)["report"].get("settings")  # a function of the user's own may report none
    made_with = flat(settings) if isinstance(settings, dict) else {}
    for name, value in flat(to_dict(train_cfg.pretraining)).items():
        if name not in OF_TRAINING and repr(made_with.get(name, value)) != repr(value):
            before = made_with[name]
            raise UserError(
                f"the pre-trained policy '{file}' was made with pretraining.{name} {before!r}, here it is {value!r}: "
                f"remove the file to make it anew, make another one in a file of its own with --set "
                f"pretraining.file=FILE, or take it as it is with --set pretraining.{name}={before}"
            )


def read_pretrained(file: Path) -> dict[str, Any]:
    """Return what a file of a pre-trained policy holds; a UserError if it is not one."""
    content = checkpoint.read(file, "pre-trained policy", "cpu")
    parts = ("actor_state_dict", "spaces", "report")
    if not isinstance(content, dict) or not all(isinstance(content.get(part), dict) for part in parts):
        raise UserError(f"'{file}' is not a pre-trained policy")
    return content


def spaces(env_cfg: Any, train_cfg: Any) -> dict[str, Any]:
    """Return the settings of :data:`SPACES`, by dotted path."""
    entries = {"env": flat(to_dict(env_cfg)), "train": flat(to_dict(train_cfg))}
    return {
        name: value
        for part, paths in SPACES.items()
        for path in paths
        for name, value in entries[part].items()
        if f"{name}.".startswith(f"{path}.")
    }
