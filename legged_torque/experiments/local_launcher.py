"""Steps of an experiment as processes on this machine, several at a time on each device."""

import contextlib
import os
import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterator
from typing import Annotated, Any, BinaryIO

from legged_torque.experiments.matrix import Cell, CellState, Matrix, command_of, step_words
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.distributed import ending_with_parent, usable_cores
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import Limits, check_value

CPU_JOBS, GPU_JOBS, MPS_JOBS = 1, 2, 4
"""Steps at a time on the CPU, a GPU, and a GPU with ``--mps``, by default: more are hardly faster."""
Jobs = Annotated[int, Limits(1, 1000)] | None
"""Steps at a time on each device; None is the default."""
MPS = "nvidia-cuda-mps-control"


class LocalProcess(subprocess.Popen[bytes]):
    """A process that gets SIGTERM when this one ends for any reason. Ctrl-C reaches only this one, to be passed on."""

    def __init__(self, place: str, command: list[str], log: BinaryIO, variables: dict[str, str], **how: Any) -> None:
        """Start a command with additional environment variables, whose output goes to ``log``."""
        self.place = place
        super().__init__(
            ending_with_parent(command),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1"} | variables,
            start_new_session=True,
            **how,
        )


class LocalLauncher:
    """Starts each step on the device with the fewest steps.

    Attributes:
        device: The --device of steps, "cpu" or "cuda:0": a process sees only its own GPU.
        variables: Additional environment variables of all steps.
    """

    def __init__(self, device: str, jobs: int | None) -> None:
        """Use the CPU or one GPU or, with "auto", all GPUs, for ``jobs`` steps each; UserError if not possible."""
        import torch

        first = resolve_device(device)  # does not create a CUDA context
        check_value("--jobs", jobs, Jobs)
        self.device = "cpu" if first == "cpu" else "cuda:0"
        self._devices: dict[str, dict[str, str]] = {"cpu": {}}  # environment variables by name of the device
        if first != "cpu":
            numbers = range(torch.cuda.device_count()) if device == "auto" else [int(first.removeprefix("cuda:"))]
            visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(torch.cuda.device_count())))
            names = [name.strip() for name in visible.split(",")]
            self._devices = {f"cuda:{number}": {"CUDA_VISIBLE_DEVICES": names[number]} for number in numbers}
        self._room = len(self._devices) * (jobs or (CPU_JOBS if first == "cpu" else GPU_JOBS))
        self.variables: dict[str, str] = {}
        if self._room > 1 and "OMP_NUM_THREADS" not in os.environ:  # steps share the cores
            self.variables["OMP_NUM_THREADS"] = str(max(1, usable_cores() // self._room))
        self._running: list[LocalProcess] = []

    def room(self) -> int:
        """Return how many steps can run at a time."""
        return self._room

    def start(self, matrix: Matrix, cell: Cell, state: CellState, log: BinaryIO, lock: BinaryIO) -> LocalProcess:
        """Start a process, which holds the lock too."""
        self._running = [process for process in self._running if process.poll() is None]
        busy = Counter(process.place for process in self._running)
        place = min(self._devices, key=lambda name: busy[name])
        command = command_of(step_words(matrix, cell, state, self.device))
        process = LocalProcess(place, command, log, self.variables | self._devices[place], pass_fds=[lock.fileno()])
        self._running.append(process)
        return process


@contextlib.contextmanager
def multi_process_service() -> Iterator[dict[str, str]]:
    """Start NVIDIA's Multi-Process Service (MPS), by which processes run kernels on a GPU at once instead of in turns.

    Yields the environment variables of the processes that use it; a UserError if this machine has none.
    """
    with tempfile.TemporaryDirectory(prefix="mps-", ignore_cleanup_errors=True) as folder:
        variables = dict.fromkeys(("CUDA_MPS_PIPE_DIRECTORY", "CUDA_MPS_LOG_DIRECTORY"), folder)
        control_service(variables, ["-d"])
        try:
            yield variables
        finally:
            control_service(variables, [], "quit\n")


def control_service(variables: dict[str, str], arguments: list[str], commands: str = "") -> None:
    """Call NVIDIA's program; a UserError if it is missing or refuses."""
    environment = os.environ | variables
    environment.pop("CUDA_VISIBLE_DEVICES", None)  # the service would number the devices anew
    with tempfile.TemporaryFile("w+") as output:  # no pipe: the service would hold it open
        how: dict[str, Any] = {"stdout": output, "stderr": subprocess.STDOUT, "start_new_session": True}
        try:
            status = subprocess.run([MPS, *arguments], input=commands, text=True, env=environment, **how).returncode
        except FileNotFoundError:
            raise UserError(f"--mps needs the program {MPS}, which comes with NVIDIA's driver") from None
        if status:
            output.seek(0)
            raise UserError(f"--mps: {MPS} says: {' '.join(output.read().split())}")
