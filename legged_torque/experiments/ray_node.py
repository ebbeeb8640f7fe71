"""A step of an experiment on a machine of a Ray cluster: files come in, a process runs, files go back.

Machines need not share a file system. Plain files are sent, by their paths below the folder of the results, and the
name of a script of this package with its arguments.
"""

import contextlib
import hashlib
import re
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import legged_torque
from legged_torque.experiments.local_launcher import LocalProcess
from legged_torque.experiments.matrix import command_of
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import write_whole
from legged_torque.utils.runs import package_versions

Files = dict[str, bytes]  # contents by path below the folder of the results
REPORT_EVERY = 1.0  # seconds between reports of a running step
LOG = "output.log"
_NOT_SENT = re.compile(rf"\.\d+\.part(/|$)|^{LOG}$")


@dataclass
class Report:
    """News of a step since its last report."""

    place: str  # the machine and its device, for the user: "10.0.0.3 cuda:1"
    status: int | None  # exit status of the process; None while it runs
    log: bytes = b""  # what it has written
    files: Files = field(default_factory=dict)  # new and changed ones


class NodeStep:
    """A step in a temporary folder. Ray makes an actor of it."""

    _process: LocalProcess | None = None

    def run(
        self, words: list[str], files: Files, versions: dict[str, str], device: str, send_every: float
    ) -> Iterator[Report]:
        """Run a script, given by its name and arguments, and report until it has ended.

        New files are sent at the end, and before every ``send_every`` seconds. A UserError if ``versions`` are not
        those of this machine.
        """
        import ray

        address = ray.util.get_node_ip_address()
        gpus = ray.get_runtime_context().get_accelerator_ids().get("GPU", [])
        place = f"{address} cuda:{gpus[0]}" if gpus else f"{address} {device}"
        check_versions(f"{address} ({socket.gethostname()})", versions, versions_here())
        with tempfile.TemporaryDirectory(prefix="legged_torque_") as folder:
            write_files(Path(folder), files)
            sent, report = time.time(), Report(place, None)
            with open(Path(folder, LOG), "wb") as output, open(Path(folder, LOG), "rb") as log:
                self._process = LocalProcess(place, command_of(words), output, {}, cwd=folder)
                yield report
                while report.status is None:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        report.status = self._process.wait(REPORT_EVERY)
                    report.log, now = log.read(), time.time()
                    if report.status is not None or now - sent >= send_every:
                        report.files, sent = new_files(Path(folder), sent), now
                    if report.status is None:
                        yield report
                        report = Report(place, None)
        yield report  # when the folder is gone: the actor may end at any moment now

    def terminate(self) -> None:
        """Ask the process to end."""
        if self._process is not None:
            self._process.terminate()


def is_checkpoint(name: str) -> bool:
    """Return whether a path is that of a checkpoint."""
    return PurePosixPath(name).match("model_*.pt")


def new_files(root: Path, since: float) -> Files:
    """Return the files below a folder that have changed since a time, apart from the log and what is being written."""
    files = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        with contextlib.suppress(FileNotFoundError):  # it is being replaced
            if path.is_file() and path.stat().st_mtime >= since and not _NOT_SENT.search(name):
                files[name] = path.read_bytes()
    return files


def write_files(root: Path, files: Files) -> None:
    """Write files below a folder, checkpoints last, since they make the others count.

    A UserError, and nothing written, if a path leads elsewhere.
    """
    for name in files:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or not path.parts or "\0" in name:
            raise UserError(f"a file of another machine would be written to {name!r}")
    for name in sorted(files, key=is_checkpoint):
        write_whole(root / name, files[name])


def versions_here() -> dict[str, str]:
    """Return what must be the same on all machines: versions of packages, and a digest of this package's code."""
    digest = hashlib.sha256()
    folder, scripts = Path(legged_torque.__file__).parent, legged_torque.SCRIPTS_DIR
    package = [file for file in sorted(folder.rglob("*.py")) if scripts not in file.parents]  # a wheel holds both
    for file in (*package, *sorted(scripts.glob("*.py"))):
        digest.update(file.read_bytes())
    return {**package_versions(), "code of legged_torque": digest.hexdigest()[:12]}


def check_versions(machine: str, wanted: dict[str, str], found: dict[str, str]) -> None:
    """Refuse a machine with another version of anything, by UserError."""
    for name, version in wanted.items():
        if found.get(name) != version:
            other = found.get(name, "not at all")
            raise UserError(f"the machine {machine} has {name} {other}, this one has {version}")
