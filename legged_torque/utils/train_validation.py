"""Training settings that make no sense are refused before anything is built."""

from __future__ import annotations

import operator
from pathlib import Path
from typing import Any

from rsl_rl.utils import resolve_callable, resolve_nn_activation

from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import check_section

_WITH_CLASSES = ("actor.distribution_cfg", "runner", "algorithm", "actor", "critic")


def check_train_cfg(train_cfg: Any) -> None:
    """Raise a UserError that names the first setting of a training that makes no sense."""

    def value_of(path: str) -> Any:
        return operator.attrgetter(path)(train_cfg)

    check_section(train_cfg)
    rate = train_cfg.algorithm
    if rate.schedule == "adaptive" and rate.learning_rate > rate.max_learning_rate:
        raise UserError(
            f"algorithm.learning_rate must be at most algorithm.max_learning_rate, {rate.max_learning_rate}, not "
            f"{rate.learning_rate}"
        )
    if train_cfg.pretraining.file and not train_cfg.pretraining.function:
        raise UserError("pretraining.file is set, but nothing starts from it: the task's pretraining.function is empty")
    for key in ("run_name", "experiment_name"):
        value = getattr(train_cfg.runner, key)
        if value and Path(value).name != value:
            raise UserError(f"runner.{key} must be a name, not the path '{value}'")
    resolvable = dict.fromkeys((f"{owner}.class_name" for owner in _WITH_CLASSES), resolve_callable)
    resolvable |= dict.fromkeys(("actor.activation", "critic.activation"), resolve_nn_activation)
    for path, resolve in resolvable.items():
        try:
            resolve(value_of(path))
        except (ValueError, ImportError, AttributeError) as error:
            raise UserError(f"{path}: {error}") from None
