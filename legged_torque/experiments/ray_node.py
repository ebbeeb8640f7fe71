"""A step of an experiment on a machine of a Ray cluster: files come in, a process runs, files go back.

Machines need not share a file system. Plain files are sent, by their paths below the folder of the results, and the
name of a script of this package with its arguments. Each step is a process of its own: nothing slow is imported here.
"""

import contextlib
import hashlib
import re
import socket
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import legged_torque
from legged_torque.experiments.local_launcher import LocalProcess
from legged_torque.experiments.matrix import command_of
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import part_of, remove_stale_parts, write_whole
from legged_torque.utils.runs import package_versions

Files = dict[str, bytes]  # contents by path below the folder of the results
Version = tuple[int, int, int]  # of a file: when it was written [ns], its size, and its number in the file system
REPORT_EVERY = 1.0  # seconds between reports of a running step
LOG = "output.log"
_NOT_SENT = re.compile(rf"\.\d+\.part(/|$)|^{LOG}$")


@dataclass
class Report:
    """News of a step since its last report."""

    place: str  # the machine and its device, for the user: "10.0.0.3 cuda:1"
    status: int | None = None  # exit status of the process; None while it runs
    log: bytes = b""  # what it has written
    files: Files = field(default_factory=dict)  # new and changed ones


class NodeStep:
    """A step in a temporary folder of a machine. Ray makes an actor of it."""

    def start(self, words: list[str], files: Files, versions: dict[str, str], device: str) -> Report:
        """Start a script, given by its name and arguments; a UserError if this machine has not these ``versions``."""
        import ray

        address = ray.util.get_node_ip_address()
        gpus = ray.get_runtime_context().get_accelerator_ids().get("GPU", [])
        place = f"{address} cuda:{gpus[0]}" if gpus else f"{address} {device}"
        found = versions_here()
        for name, version in versions.items():
            if found.get(name) != version:
                differs = f"has {name} {found.get(name, 'not at all')}, this one has {version}"
                raise UserError(f"the machine {address} ({socket.gethostname()}) {differs}")
        remove_stale_parts(Path(tempfile.gettempdir()))  # folders of steps whose actors were killed
        self._folder = tempfile.TemporaryDirectory(prefix="legged_torque_", suffix=part_of(Path("_")).name)
        root, self._sent, self._reported_at = Path(self._folder.name), dict[str, Version](), time.monotonic()
        write_files(root, files)
        new_files(root, self._sent)  # which the sender has
        with open(root / LOG, "wb") as output:
            self._process = LocalProcess(place, command_of(words), output, {}, cwd=root)
        self._reported = 0  # bytes of its log
        return Report(place)

    def report(self, send_every: float) -> Report:
        """Return news after a while; new files are sent at the end, and before every ``send_every`` seconds."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(REPORT_EVERY)
        now, root, report = time.monotonic(), Path(self._folder.name), Report(self._process.place, self._process.poll())
        log = (root / LOG).read_bytes()
        report.log, self._reported = log[self._reported :], len(log)
        if report.status is not None or now - self._reported_at >= send_every:
            report.files, self._reported_at = new_files(root, self._sent), now
        if report.status is not None:
            self._folder.cleanup()
        return report

    def terminate(self) -> None:
        """Ask the process to end."""
        self._process.terminate()


def is_checkpoint(name: str) -> bool:
    """Return whether a path is that of a checkpoint."""
    return PurePosixPath(name).match("model_*.pt")


def new_files(root: Path, sent: dict[str, Version]) -> Files:
    """Return the files below a folder that differ from those in ``sent``, which is updated.

    The log and what is being written are left out. Times alone do not tell: a file that is renamed when it is whole
    has the time of its last write.
    """
    files = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        with contextlib.suppress(FileNotFoundError):  # it is being replaced
            about = path.stat()
            version = about.st_mtime_ns, about.st_size, about.st_ino
            if path.is_file() and sent.get(name) != version and not _NOT_SENT.search(name):
                files[name], sent[name] = path.read_bytes(), version
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
    versions = package_versions() | {"code of legged_torque": digest.hexdigest()[:12]}
    del versions["legged_torque"]  # says less
    return versions
