"""Training settings that make no sense are refused before anything is built."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rsl_rl.utils import resolve_callable, resolve_nn_activation

from legged_torque.utils.errors import UserError, unknown_name

SCHEDULES = ("adaptive", "fixed")
STD_TYPES = ("log", "scalar")


def check_train_cfg(train_cfg: Any) -> None:
    """Check the settings of a training.

    Raises:
        UserError: Naming the first setting that makes no sense.
    """
    for section, keys in {
        "runner": ("num_steps_per_env", "total_steps", "save_interval"),
        "algorithm": ("num_learning_epochs", "num_mini_batches"),
        "evaluation": ("num_samples", "num_envs"),
    }.items():
        for key in keys:
            value = getattr(getattr(train_cfg, section), key)
            if value < 1:
                raise UserError(f"{section}.{key} must be at least 1, not {value}")
    if train_cfg.evaluation.interval < 0:
        raise UserError(f"evaluation.interval must be at least 0, not {train_cfg.evaluation.interval}")
    if train_cfg.pretraining.critic_warmup_iterations < 0:
        iterations = train_cfg.pretraining.critic_warmup_iterations
        raise UserError(f"pretraining.critic_warmup_iterations must be at least 0, not {iterations}")
    if train_cfg.pretraining.file and not train_cfg.pretraining.function:
        raise UserError("pretraining.file is set, but nothing starts from it: the task's pretraining.function is empty")
    for key in ("learning_rate", "max_learning_rate", "max_grad_norm", "clip_param"):
        value = getattr(train_cfg.algorithm, key)
        if not value > 0.0:
            raise UserError(f"algorithm.{key} must be greater than 0, not {value}")
    for key in ("run_name", "experiment_name"):
        value = getattr(train_cfg.runner, key)
        if value and Path(value).name != value:
            raise UserError(f"runner.{key} must be a name, not the path '{value}'")
    if not 0 <= train_cfg.seed < 2**63:
        raise UserError(f"seed must be from 0 to 2^63 - 1, not {train_cfg.seed}")
    if train_cfg.algorithm.schedule not in SCHEDULES:
        raise unknown_name("algorithm.schedule", train_cfg.algorithm.schedule, SCHEDULES)
    distribution = train_cfg.actor.distribution_cfg
    if distribution.std_type not in STD_TYPES:
        raise unknown_name("actor.distribution_cfg.std_type", distribution.std_type, STD_TYPES)
    if not distribution.init_std > 0.0:
        raise UserError(f"actor.distribution_cfg.init_std must be greater than 0, not {distribution.init_std}")
    _check_with(resolve_callable, "actor.distribution_cfg.class_name", distribution.class_name)
    for section in ("runner", "algorithm", "actor", "critic"):
        _check_with(resolve_callable, f"{section}.class_name", getattr(train_cfg, section).class_name)
    for section in ("actor", "critic"):
        _check_with(resolve_nn_activation, f"{section}.activation", getattr(train_cfg, section).activation)
        sizes = getattr(train_cfg, section).hidden_dims
        if not sizes or min(sizes) < 1:
            raise UserError(f"{section}.hidden_dims must be one size or more, each at least 1, not {sizes}")


def _check_with(resolve: Any, key: str, name: str) -> None:
    """Refuse a name that rsl_rl cannot resolve."""
    try:
        resolve(name)
    except (ValueError, ImportError, AttributeError) as error:
        raise UserError(f"{key}: {error}") from None
