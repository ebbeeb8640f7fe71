"""Policies made by supervision before reinforcement learning: their files, and trainings that start from one.

A file holds the policy's network and the settings that give its inputs and outputs their meaning. It is used again
wherever these are the same, and refused where they differ.
"""

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
from legged_torque.utils.options import LAW, law_of_motors
from legged_torque.utils.runs import PRETRAINED, with_present_names

SPACES = {
    "env": (
        "asset.file",
        "init_state.default_joint_angles",
        LAW,
        "motors.drive",
        "motors.muscle",
        "env.history_length",
        "sim.dt",
        "control",
        "normalization",
        "terrain.measure_heights",
        "terrain.measured_points_x",
        "terrain.measured_points_y",
    ),
    "train": (
        "actor.class_name",
        "actor.hidden_dims",
        "actor.head_hidden_dims",
        "actor.activation",
        "obs_groups.actor",
    ),
}
"""Settings of task and training that a pre-trained policy must share, as far as there are such settings."""
OF_TRAINING = ("file", "critic_warmup_iterations")
"""Settings of ``pretraining`` about a training that starts from the policy, not about the making of the policy."""
STANDARD_DEVIATION = "distribution."
"""Start of the names of parameters that are not taken over: a training has its own setting of exploration."""


def pretrained_file(task: str, train_cfg: Any, log_root: str | None = None) -> Path:
    """Return where a task's pre-trained policy is kept: ``pretraining.file``, or in the folder of all experiments."""
    if train_cfg.pretraining.file:
        return Path(train_cfg.pretraining.file)
    return Path(log_root or "logs") / PRETRAINED / f"{task}.pt"


def find_pretrained(file: Path, task: str, env_cfg: Any, train_cfg: Any, device: str) -> None:
    """Make a task's pre-trained policy if its file is missing.

    Of trainings that start at the same time, one makes the policy and the others wait.

    Raises:
        UserError: If the policy does not fit the task, or was made with other settings of ``pretraining``, with which
            it may not even stand.
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
    """Make a task's pre-trained policy and return the report on it; a UserError if the task has none that does so."""
    if not train_cfg.pretraining.function:
        raise UserError(f"task '{task}' has no pre-training: its pretraining.function is empty")
    check_output(file)
    made = resolve_callable(train_cfg.pretraining.function)(task, env_cfg, train_cfg, device)
    if not (isinstance(made, tuple) and len(made) == 2 and isinstance(made[1], dict)):
        raise UserError("pretraining.function must return a network and a dictionary, the report on it")
    actor, report = made
    content = {"actor_state_dict": actor.state_dict(), "spaces": spaces(env_cfg, train_cfg), "report": report}
    checkpoint.write(file, content)
    return report


def start_from(runner: OnPolicyRunner, file: Path) -> None:
    """Give the actor of a runner the network of a pre-trained policy, without its standard deviation.

    Raises:
        UserError: If a parameter is missing, of another shape or not finite; the actor is unchanged then.
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
        if name in of_file and repr(of_file[name]) != repr(value):
            raise UserError(
                f"the pre-trained policy '{file}' does not fit this task: its {name} is {of_file[name]!r}, here it "
                f"is {value!r}; make another one in a file of its own: --set pretraining.file=FILE"
            )


def check_making(file: Path, train_cfg: Any) -> None:
    """Refuse a pre-trained policy that was made with other settings of ``pretraining``, naming the first one."""
    settings = with_present_names(read_pretrained(file)["report"].get("settings"))  # a user's function may report none
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
    """Return the contents of a file of a pre-trained policy; a UserError if it is not one."""
    content = checkpoint.read(file, "pre-trained policy", "cpu")
    parts = ("actor_state_dict", "spaces", "report")
    if not isinstance(content, dict) or not all(isinstance(content.get(part), dict) for part in parts):
        raise UserError(f"'{file}' is not a pre-trained policy")
    return content


def spaces(env_cfg: Any, train_cfg: Any) -> dict[str, Any]:
    """Return the settings of :data:`SPACES`, by dotted path."""
    entries = {"env": flat(to_dict(env_cfg)) | law_of_motors(env_cfg), "train": flat(to_dict(train_cfg))}
    return {
        name: value
        for part, paths in SPACES.items()
        for path in paths
        for name, value in entries[part].items()
        if f"{name}.".startswith(f"{path}.")
    }
