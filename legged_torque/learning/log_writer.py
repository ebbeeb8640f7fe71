"""A logging backend for ``--logger none``."""

from __future__ import annotations

from rsl_rl.utils import LogWriter


class NoLogWriter(LogWriter):
    """Writes nothing; the console and the checkpoints are all that is left."""

    def __init__(self, log_dir: str) -> None:
        """Accept what rsl_rl passes to a backend."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """Drop the value."""
