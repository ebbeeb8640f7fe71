"""Steps of an experiment on the machines of a Ray cluster, started, watched and gathered from this one."""

from __future__ import annotations

import dataclasses
import logging
import os
import signal
import time
from pathlib import Path
from typing import Any, BinaryIO

from legged_torque.experiments.job import GPU_JOBS, LOST, Worker
from legged_torque.experiments.local_launcher import check_jobs
from legged_torque.experiments.matrix import Cell, CellState, Matrix, last_checkpoint, step_words
from legged_torque.experiments.ray_node import Files, News, NodeStep, read_files, versions_here, write_files
from legged_torque.learning.worlds import remove_other_worlds, worlds_file
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import CONFIG_FILE

LOOK_EVERY = 5.0  # seconds between looks at what the cluster has
WAIT = 1.0  # seconds for which a machine waits before it says that nothing has ended


class RayLauncher:
    """Gives each step to Ray, which finds a machine with a free GPU, or share of one, for it."""

    def __init__(self, address: str, device: str, jobs: int | None) -> None:
        """Join the cluster at an address; a UserError if Ray is not installed, or there is no cluster."""
        try:
            import ray
        except ImportError:
            raise UserError("--launcher ray needs the extra: pip install -e .[ray]") from None
        check_jobs(jobs)
        if device not in ("auto", "cuda", "cpu"):
            raise UserError(f"on a cluster, --device must be auto, cuda or cpu, not '{device}': Ray chooses the GPUs")
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.CRITICAL)
        except (ConnectionError, RuntimeError, ValueError) as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            hint = "start one with 'ray start --head'"
            raise UserError(f"there is no Ray cluster at address '{address}' ({hint}): {reason}") from None
        self._ray, self._versions, self._out_of_place = ray, versions_here(), 0.0
        on_gpus = device == "cuda" or (device == "auto" and self._total("GPU") > 0)
        if not on_gpus and jobs is not None:
            raise UserError("--jobs is for GPUs on a cluster: on CPUs, Ray runs as many at a time as there are cores")
        self._share = 1.0 / (jobs or GPU_JOBS) if on_gpus else 0.0  # of a GPU, for each step
        self._device = "cuda:0" if on_gpus else "cpu"
        self._workers: list[Worker] = []
        self._looked = -LOOK_EVERY
        if not self.workers():
            raise UserError(f"the Ray cluster at address '{address}' has no machine with a free {self._device[:4]}")
