"""Training settings that make no sense are refused before anything is built."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import check_section


def check_train_cfg(train_cfg: Any) -> None:
    """Raise a UserError that names the first setting of a training that makes no sense."""
    check_section(train_cfg)
    rate = train_cfg.algorithm
    if getattr(rate, "schedule", None) == "adaptive" and rate.learning_rate > rate.max_learning_rate:
        raise UserError(
            f"algorithm.learning_rate must be at most algorithm.max_learning_rate, {rate.max_learning_rate}, not "
            f"{rate.learning_rate}"
        )
    if train_cfg.pretraining.file and not train_cfg.pretraining.function:
        raise UserError("pretraining.file is set, but nothing starts from it: the task's pretraining.function is empty")
    for key in ("run_name", "experiment_name"):
        value = getattr(train_cfg.runner, key)
        if value and (Path(value).name != value or value == ".." or not value.isprintable()):
            raise UserError(f"runner.{key} must be a name, not the path '{value}'")
    from rsl_rl.utils import resolve_nn_activation  # takes seconds: all else is told before

    for network in ("actor", "critic"):
        try:
            resolve_nn_activation(getattr(train_cfg, network).activation)
        except ValueError as error:
            raise UserError(f"{network}.activation: {error}") from None
