"""Steps of an experiment as processes on this machine."""

from __future__ import annotations

import os
import subprocess
from typing import BinaryIO

from legged_torque.experiments.job import CPU_JOBS, GPU_JOBS, MAX_JOBS, Worker
from legged_torque.experiments.matrix import Cell, CellState, Matrix, command_of, step_words
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.errors import UserError
from legged_torque.utils.processes import ending_with_parent


class LocalLauncher:
    """Starts steps as processes, several at a time on each device."""

    def __init__(self, device: str, jobs: int | None) -> None:
        """Choose the devices, see :func:`find_workers`."""
        self._workers = find_workers(device, jobs)

    def workers(self) -> list[Worker]:
        """Return all workers, busy or not."""
        return self._workers

    def start(
        self, matrix: Matrix, cell: Cell, state: CellState, worker: Worker, log: BinaryIO, lock: BinaryIO
    ) -> subprocess.Popen[bytes]:
        """Start a process, which holds the lock too, and gets SIGTERM if this process ends."""
        command = command_of(step_words(matrix, cell, state, worker.device))
        return start_process(command, log, worker.variables, [lock.fileno()])


def start_process(
    command: list[str], log: BinaryIO, variables: dict[str, str], pass_fds: list[int], cwd: str | None = None
) -> subprocess.Popen[bytes]:
    """Start a process that writes to ``log``, and gets SIGTERM when this process ends for any reason."""
    return subprocess.Popen(
        ending_with_parent(command),
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        env=os.environ | {"PYTHONUNBUFFERED": "1"} | variables,
        pass_fds=pass_fds,
        cwd=cwd,
        start_new_session=True,  # Ctrl-C reaches only this process, which passes it on
    )


def check_jobs(jobs: int | None) -> None:
    """Refuse, by UserError, a number of runs at a time that makes no sense."""
    if jobs is not None and jobs < 1:
        raise UserError(f"--jobs must be at least 1, not {jobs}")
    if jobs is not None and jobs > MAX_JOBS:
        raise UserError(f"--jobs must be at most {MAX_JOBS}, not {jobs}")


def find_workers(device: str, jobs: int | None) -> list[Worker]:
    """Return ``jobs`` workers for each device, the CPU or one GPU or, with "auto", all GPUs; UserError if not possible.

    The first workers are on different devices. Several share the cores among them.
    """
    import torch

    first = resolve_device(device)  # does not create a CUDA context
    check_jobs(jobs)
    if first == "cpu":
        devices: list[tuple[str, str, dict[str, str]]] = [("cpu", "cpu", {})]
    else:
        numbers = range(torch.cuda.device_count()) if device == "auto" else [int(first.removeprefix("cuda:"))]
        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        names = visible.split(",") if visible else [str(i) for i in range(torch.cuda.device_count())]
        devices = [(f"cuda:{i}", "cuda:0", {"CUDA_VISIBLE_DEVICES": names[i].strip()}) for i in numbers]
    jobs = jobs or (CPU_JOBS if first == "cpu" else GPU_JOBS)
    count, shared = jobs * len(devices), {}
    if count > 1 and "OMP_NUM_THREADS" not in os.environ:
        shared["OMP_NUM_THREADS"] = str(max(1, (os.cpu_count() or 1) // count))
    return [Worker(name, kind, variables | shared) for _ in range(jobs) for name, kind, variables in devices]
