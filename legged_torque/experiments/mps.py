"""NVIDIA's Multi-Process Service (MPS): processes that share a GPU run their kernels at once instead of in turns."""

from __future__ import annotations

import contextlib
import os
import subprocess
import tempfile
from collections.abc import Iterator

from legged_torque.utils.errors import UserError

PROGRAM = "nvidia-cuda-mps-control"
FOLDERS = ("CUDA_MPS_PIPE_DIRECTORY", "CUDA_MPS_LOG_DIRECTORY")


@contextlib.contextmanager
def multi_process_service() -> Iterator[None]:
    """Let processes that start while this context is open share GPUs by a service of their own.

    A UserError if this machine has none.
    """
    with tempfile.TemporaryDirectory(prefix="mps-", ignore_cleanup_errors=True) as folder:
        before = {name: os.environ.get(name) for name in FOLDERS}
        os.environ |= dict.fromkeys(FOLDERS, folder)
        try:
            control(["-d"])
            try:
                yield
            finally:
                control([], "quit\n")
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})


def control(arguments: list[str], commands: str = "") -> None:
    """Call NVIDIA's program; a UserError if it is missing or refuses."""
    variables = {name: value for name, value in os.environ.items() if name != "CUDA_VISIBLE_DEVICES"}  # else renumbered
    with tempfile.TemporaryFile("w+") as said:  # no pipe: the service would hold it open
        try:
            ended = subprocess.run(
                [PROGRAM, *arguments],
                input=commands,
                text=True,
                stdout=said,
                stderr=subprocess.STDOUT,
                env=variables,
                start_new_session=True,  # Ctrl-C does not reach the service
            )
        except FileNotFoundError:
            raise UserError(f"--mps needs the program {PROGRAM}, which comes with NVIDIA's driver") from None
        if ended.returncode:
            said.seek(0)
            raise UserError(f"--mps: {PROGRAM} says: {' '.join(said.read().split())}")
