"""Training settings that make no sense are refused before anything is built."""

from __future__ import annotations

from typing import Any

from rsl_rl.utils import resolve_callable, resolve_nn_activation

from legged_torque.utils.errors import UserError


def check_train_cfg(train_cfg: Any) -> None:
    """Check the settings of a training.

    Raises:
        UserError: Naming the first setting that makes no sense.
    """
    for section, keys in {
        "runner": ("num_steps_per_env", "total_steps", "save_interval"),
        "algorithm": ("num_learning_epochs", "num_mini_batches"),
    }.items():
        for key in keys:
            value = getattr(getattr(train_cfg, section), key)
            if value < 1:
                raise UserError(f"{section}.{key} must be at least 1, not {value}")
    for key in ("learning_rate", "max_grad_norm", "clip_param"):
        value = getattr(train_cfg.algorithm, key)
        if not value > 0.0:
            raise UserError(f"algorithm.{key} must be greater than 0, not {value}")
    for section in ("runner", "algorithm", "actor", "critic"):
        _check_with(resolve_callable, f"{section}.class_name", getattr(train_cfg, section).class_name)
    for section in ("actor", "critic"):
        _check_with(resolve_nn_activation, f"{section}.activation", getattr(train_cfg, section).activation)
        if any(size < 1 for size in getattr(train_cfg, section).hidden_dims):
            raise UserError(f"{section}.hidden_dims must be at least 1 each")


def _check_with(resolve: Any, key: str, name: str) -> None:
    """Refuse a name that rsl_rl cannot resolve."""
    try:
        resolve(name)
    except (ValueError, ImportError, AttributeError) as error:
        raise UserError(f"{key}: {error}") from None
