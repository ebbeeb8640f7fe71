"""Steps of an experiment on the machines of a Ray cluster."""

import logging
import signal
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

from legged_torque.experiments.job import LOST
from legged_torque.experiments.local_launcher import GPU_JOBS, Jobs
from legged_torque.experiments.matrix import Cell, CellState, Matrix, last_checkpoint, step_words
from legged_torque.experiments.ray_node import NodeStep, Report, is_checkpoint, versions_here, write_files
from legged_torque.learning.worlds import remove_older_worlds, worlds_file
from legged_torque.utils.errors import UserError, require
from legged_torque.utils.limits import check_value
from legged_torque.utils.runs import CONFIG_FILE, PRETRAINED

SEND_EVERY = 60.0  # seconds between checkpoints that are brought home while a training goes on
ANSWER = 10.0  # seconds within which a cluster must answer


class RayLauncher:
    """Gives each step to Ray, which finds a machine with a free GPU, or share of one, for it.

    Attributes:
        device: The --device of steps, "cpu" or "cuda:0": Ray shows each its own GPU.
    """

    def __init__(self, address: str, device: str, jobs: int | None) -> None:
        """Join the cluster at an address; a UserError if Ray is not installed, or there is no cluster."""
        check_value("--jobs", jobs, Jobs)
        if device not in ("auto", "cuda", "cpu"):
            raise UserError(f"on a cluster, --device must be auto, cuda or cpu, not '{device}': Ray chooses the GPUs")
        self._ray = join_cluster(address)
        on_gpus = device == "cuda" or (device == "auto" and self._ray.cluster_resources().get("GPU", 0.0) > 0)
        if not on_gpus and jobs is not None:
            raise UserError("--jobs is for GPUs on a cluster: of runs on CPUs, each takes one core")
        self._per_gpu = (jobs or GPU_JOBS) if on_gpus else 0
        self.device = "cuda:0" if on_gpus else "cpu"
        if not self.room():
            raise UserError(f"the Ray cluster at address '{address}' has no {'GPU' if on_gpus else 'CPU'}")

    def room(self) -> int:
        """Return how many steps the machines can run at a time; they may come and go."""
        resources = self._ray.cluster_resources()
        cores = int(resources.get("CPU", 0.0))
        return min(cores, int(resources.get("GPU", 0.0) * self._per_gpu)) if self._per_gpu else cores

    def start(self, matrix: Matrix, cell: Cell, state: CellState, log: BinaryIO, lock: BinaryIO) -> "RayProcess":
        """Ask Ray to start a step somewhere; the lock is held by this process alone."""
        words = step_words(matrix, replace(cell, folder=Path(cell.name)), state, self.device)
        share = 1.0 / self._per_gpu if self._per_gpu else 0.0
        actor = self._ray.remote(NodeStep).options(num_cpus=1, num_gpus=share).remote()
        out, newest = cell.folder.parent, last_checkpoint(cell)
        needed = [out / PRETRAINED / f"{cell.task}.pt"]
        if newest:
            needed = [newest, worlds_file(newest), newest.with_name(CONFIG_FILE)]
        files = {file.relative_to(out).as_posix(): file.read_bytes() for file in needed if file.is_file()}
        first = actor.start.remote(words, files, versions_here(), self.device)
        return RayProcess(actor, first, cell, Path(log.name))


class RayProcess:
    """A step on some machine, which looks like a process of this one."""

    def __init__(self, actor: Any, first: Any, cell: Cell, log: Path) -> None:
        """Watch an actor of :class:`NodeStep`, from which the ``first`` report will come."""
        self.place = ""
        self._actor, self._next, self._cell, self._log = actor, first, cell, log
        self._status: int | None = None

    def poll(self) -> int | None:
        """Take what has come from the machine; return the exit status, :data:`LOST`, or None while the step runs.

        A UserError if the machine must not be used, or its files cannot be written here.
        """
        import ray
        from ray.exceptions import RayError, RayTaskError

        if self._status is not None or not ray.wait([self._next], timeout=0.0)[0]:
            return self._status
        try:
            report = ray.get(self._next)
            self._status = report.status
            self._take(report)
        except RayError as error:
            self._status = 1 if isinstance(error, RayTaskError) else LOST
            if isinstance(error, RayTaskError) and isinstance(error.cause, UserError):
                raise UserError(error.cause) from None
            with self._log.open("a", encoding="utf-8") as log:
                log.write(f"{error}\n")
        except UserError:
            self._status = 1
            raise
        if self._status is None:
            self._next = self._actor.report.remote(SEND_EVERY)
        else:
            self._actor = None  # Ray ends it
        return self._status

    def terminate(self) -> None:
        """Ask the process to end, or Ray not to start it any more."""
        import ray

        if self._status is None and self.place:
            self._actor.terminate.remote()
        elif self._status is None:
            ray.kill(self._actor)
            self._status = -signal.SIGTERM

    def _take(self, report: Report) -> None:
        """Keep what a machine has sent: files of the cell, and a pre-trained policy that is not there yet."""
        self.place = report.place
        with self._log.open("ab") as log:
            log.write(report.log)
        out = self._cell.folder.parent
        for name in list(report.files):
            is_new_policy = name.startswith(f"{PRETRAINED}/") and not (out / name).exists()
            if not name.startswith(f"{self._cell.name}/") and not is_new_policy:
                del report.files[name]
        write_files(out, report.files)
        if any(map(is_checkpoint, report.files)) and (newest := last_checkpoint(self._cell)):
            remove_older_worlds(newest)


def join_cluster(address: str) -> Any:
    """Join the cluster at an address, "auto" or HOST:PORT, and return the package ray; see :class:`RayLauncher`."""
    require("ray", extra="ray")
    import ray

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
