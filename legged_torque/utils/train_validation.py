"""Training settings that make no sense are refused before anything is built."""

from __future__ import annotations

import operator
from pathlib import Path
from typing import Any

from rsl_rl.utils import resolve_nn_activation

from legged_torque.utils.errors import UserError, unknown_name

SCHEDULES = ("adaptive", "fixed")
STD_TYPES = ("log", "scalar")

_AT_LEAST = {f"runner.{key}": 1 for key in ("num_steps_per_env", "total_steps", "save_interval")}
_AT_LEAST |= {"algorithm.num_learning_epochs": 1, "algorithm.num_mini_batches": 1}
_AT_LEAST |= {"evaluation.num_samples": 1, "evaluation.num_envs": 1, "evaluation.interval": 0}
_AT_LEAST |= {"pretraining.critic_warmup_iterations": 0}
_POSITIVE = [f"algorithm.{key}" for key in ("learning_rate", "max_learning_rate", "max_grad_norm", "clip_param")]
_POSITIVE += ["actor.distribution_cfg.init_std"]
_NAMES = {"algorithm.schedule": SCHEDULES, "actor.distribution_cfg.std_type": STD_TYPES}


def check_train_cfg(train_cfg: Any) -> None:
    """Raise a UserError that names the first setting of a training that makes no sense."""

    def value_of(path: str) -> Any:
        return operator.attrgetter(path)(train_cfg)

    for path, lowest in _AT_LEAST.items():
        if value_of(path) < lowest:
            raise UserError(f"{path} must be at least {lowest}, not {value_of(path)}")
    for path in _POSITIVE:
        if not value_of(path) > 0.0:
            raise UserError(f"{path} must be greater than 0, not {value_of(path)}")
    for path, names in _NAMES.items():
        if value_of(path) not in names:
            raise unknown_name(path, value_of(path), names)
    if train_cfg.pretraining.file and not train_cfg.pretraining.function:
        raise UserError("pretraining.file is set, but nothing starts from it: the task's pretraining.function is empty")
    for key in ("run_name", "experiment_name"):
        value = getattr(train_cfg.runner, key)
        if value and (Path(value).name != value or value == ".." or not value.isprintable()):
            raise UserError(f"runner.{key} must be a name, not the path '{value}'")
    if not 0 <= train_cfg.seed < 2**63:
        raise UserError(f"seed must be from 0 to 2^63 - 1, not {train_cfg.seed}")
    for section in ("actor", "critic"):
        sizes = getattr(train_cfg, section).hidden_dims
        if not sizes or min(sizes) < 1:
            raise UserError(f"{section}.hidden_dims must be one size or more, each at least 1, not {sizes}")
    for path in ("actor.activation", "critic.activation"):
        try:
            resolve_nn_activation(value_of(path))
        except ValueError as error:
            raise UserError(f"{path}: {error}") from None
