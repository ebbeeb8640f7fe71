"""Logging backends beside rsl_rl's own: for ``--logger none`` and ``--logger wandb``."""

from __future__ import annotations

from rsl_rl.utils import LogWriter
from rsl_rl.utils.wandb_log_writer import WandbLogWriter

from legged_torque.utils.config import BaseConfig, to_dict
from legged_torque.utils.errors import UserError


class NoLogWriter(LogWriter):
    """Writes nothing; the console and the checkpoints are all that is left."""

    def __init__(self, log_dir: str) -> None:
        """Accept what rsl_rl passes to a backend."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """Drop the value."""


class WandbWriter(WandbLogWriter):
    """rsl_rl's, which takes settings only as a dataclass or with a ``to_dict``."""

    def __init__(self, log_dir: str, project_name: str) -> None:
        """Start a run of wandb; a UserError if that refuses, as it does without a key."""
        import wandb

        try:
            super().__init__(log_dir, project_name)
        except wandb.Error as error:
            raise UserError(f"--logger wandb: {error}") from None

    def store_config(self, env_cfg: BaseConfig, train_cfg: dict) -> None:
        """Upload the settings of task and training."""
        import wandb

        wandb.config.update({"env_cfg": to_dict(env_cfg), "train_cfg": train_cfg})
