"""Steps of an experiment on the machines of a Ray cluster, started, watched and gathered from this one."""

from __future__ import annotations

import dataclasses
import logging
import os
import signal
import socket
import time
from pathlib import Path
from typing import Any, BinaryIO

from legged_torque.experiments.job import GPU_JOBS, LOST, Worker
from legged_torque.experiments.local_launcher import check_jobs
from legged_torque.experiments.matrix import Cell, CellState, Matrix, last_checkpoint, step_words
from legged_torque.experiments.ray_node import News, NodeStep, read_files, versions_here, write_files
from legged_torque.learning.worlds import remove_other_worlds, worlds_file
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import CONFIG_FILE, PRETRAINED

LOOK_EVERY = 5.0  # seconds between looks at what the cluster has
SEND_EVERY = 60.0  # seconds between checkpoints that are brought home while a training goes on
ANSWER = 10.0  # seconds within which a cluster must answer
WAIT = 1.0  # seconds for which a machine waits before it says that nothing has ended


class RayLauncher:
    """Gives each step to Ray, which finds a machine with a free GPU, or share of one, for it."""

    def __init__(self, address: str, device: str, jobs: int | None) -> None:
        """Join the cluster at an address; a UserError if Ray is not installed, or there is no cluster."""
        check_jobs(jobs)
        if device not in ("auto", "cuda", "cpu"):
            raise UserError(f"on a cluster, --device must be auto, cuda or cpu, not '{device}': Ray chooses the GPUs")
        ray = join_cluster(address)
        self._versions = versions_here()
        on_gpus = device == "cuda" or (device == "auto" and ray.cluster_resources().get("GPU", 0.0) > 0)
        if not on_gpus and jobs is not None:
            raise UserError("--jobs is for GPUs on a cluster: of runs on CPUs, each takes one core")
        self._share = 1.0 / (jobs or GPU_JOBS) if on_gpus else 0.0  # of a GPU, for each step
        self._device = "cuda:0" if on_gpus else "cpu"
        self._workers: list[Worker] = []
        self._looked = -LOOK_EVERY
        if not self._capacity():
            raise UserError(f"the Ray cluster at address '{address}' has no {'GPU' if on_gpus else 'CPU'}")

    def workers(self) -> list[Worker]:
        """Return as many workers as the cluster has room for, and at least one: machines may come and go."""
        if time.monotonic() - self._looked >= LOOK_EVERY:
            self._looked, wanted = time.monotonic(), max(self._capacity(), 1)
            busy = [worker for worker in self._workers if worker.job is not None]
            idle = [worker for worker in self._workers if worker.job is None]
            new = [Worker("", self._device, {}) for _ in range(wanted - len(self._workers))]
            self._workers = busy + (idle + new)[: max(wanted - len(busy), 0)]
        return self._workers

    def start(
        self, matrix: Matrix, cell: Cell, state: CellState, worker: Worker, log: BinaryIO, lock: BinaryIO
    ) -> RayProcess:
        """Ask Ray to start a step somewhere; the lock is held by this process alone."""
        import ray

        out = cell.folder.parent
        words = step_words(matrix, dataclasses.replace(cell, folder=Path(cell.name)), state, worker.device)
        actor = ray.remote(NodeStep).options(num_cpus=1, num_gpus=self._share)
        worker.name = ""  # until Ray has found a machine
        arguments = (words, read_files(out, needed_files(cell)), self._versions, worker.device, SEND_EVERY)
        return RayProcess(actor.remote(*arguments), cell, worker, Path(log.name))

    def _capacity(self) -> int:
        """Return how many steps the machines of the cluster can run at a time."""
        import ray

        per_machine = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        count = 0
        for resources in per_machine:
            cores = int(resources.get("CPU", 0.0))
            count += min(cores, round(resources.get("GPU", 0.0) / self._share)) if self._share else cores
        return count


def join_cluster(address: str) -> Any:
    """Join the cluster at an address, "auto" or HOST:PORT, and return the package ray; see :class:`RayLauncher`."""
    try:
        import ray
    except ImportError:
        raise UserError("--launcher ray needs the extra: pip install 'legged_torque[ray]'") from None
    host, _, port = address.rpartition(":")
    if address != "auto" and not (host and port.isdecimal()):
        raise UserError(f"--address must be auto or HOST:PORT, not '{address}'")
    try:
        if host:  # Ray itself tries for many minutes
            socket.create_connection((host, int(port)), timeout=ANSWER).close()
        if not ray.is_initialized():
            ray.init(address=address, log_to_driver=False, logging_level=logging.CRITICAL)
    except (OSError, OverflowError, RuntimeError, ValueError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        hint = "start one with 'ray start --head'"
        raise UserError(f"there is no Ray cluster at address '{address}' ({hint}): {reason}") from None
    return ray


class RayProcess:
    """A step on some machine, which looks like a process of this one."""

    def __init__(self, actor: Any, cell: Cell, worker: Worker, log: Path) -> None:
        """Watch the step of an actor of :class:`NodeStep`; ``worker`` gets the name of its machine and device."""
        self.pid = os.getpid()
        self.returncode: int | None = None
        self._actor, self._cell, self._worker, self._log = actor, cell, worker, log
        self._news = actor.news.remote(WAIT)

    def poll(self) -> int | None:
        """Take what has come from the machine; return the exit status, :data:`LOST`, or None while the step runs.

        A UserError if the machine must not be used, or what it has sent cannot be written here.
        """
        import ray
        from ray.exceptions import RayError, RayTaskError

        if self.returncode is not None or not ray.wait([self._news], timeout=0.0)[0]:
            return self.returncode
        try:
            news = ray.get(self._news)
        except RayError as error:
            with self._log.open("a", encoding="utf-8") as log:
                log.write(f"{error}\n")
            failed = isinstance(error, RayTaskError) or getattr(error, "actor_init_failed", False)
            self._end(1 if failed else LOST)
            return self.returncode
        try:
            self._take(news)
        except UserError:
            self._end(1)
            raise
        if news.status is None:
            self._news = self._actor.news.remote(WAIT)
        else:
            self._actor.clean.remote()
            self._end(news.status)
        return self.returncode

    def terminate(self) -> None:
        """Ask the process to end, or Ray not to start it any more."""
        import ray

        if self.returncode is None and self._worker.name:
            self._actor.terminate.remote()
        elif self.returncode is None:
            ray.kill(self._actor)
            self._end(-signal.SIGTERM)

    def wait(self) -> int:
        """Wait for the end, and return the exit status."""
        while self.poll() is None:
            time.sleep(WAIT / 10)
        assert self.returncode is not None
        return self.returncode

    def _end(self, status: int) -> None:
        """Note the exit status, and let Ray end the actor when it has done what it was asked for."""
        self.returncode, self._actor = status, None

    def _take(self, news: News) -> None:
        """Keep what a machine has sent; a UserError if it must not be used."""
        if news.refusal:
            raise UserError(news.refusal)
        self._worker.name = news.place
        with self._log.open("ab") as log:
            log.write(news.log)
        out = self._cell.folder.parent
        files = {name: content for name, content in news.files.items() if self._is_wanted(out, name)}
        write_files(out, files)
        for name in files:
            if Path(name).match("model_*.pt"):
                remove_other_worlds(out / name)

    def _is_wanted(self, out: Path, name: str) -> bool:
        """Return whether a file is of the cell, or a pre-trained policy that is not there yet."""
        folder = name.split("/")[0]
        return folder == self._cell.name or (folder == PRETRAINED and not (out / name).exists())


def needed_files(cell: Cell) -> list[str]:
    """Return what a cell's next step needs of what there is, by path below the folder of the results."""
    out, newest = cell.folder.parent, last_checkpoint(cell)
    files = [out / PRETRAINED / f"{cell.task}.pt"]
    if newest:
        files = [newest, worlds_file(newest), newest.with_name(CONFIG_FILE)]
    return [file.relative_to(out).as_posix() for file in files if file.is_file()]
