"""A step of an experiment on a machine of a Ray cluster: files come in, a process runs, files go back.

Machines need not share a file system. What is sent is plain files, by their paths below the folder of the results, and
the name of a script of this package with its arguments.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import socket
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import legged_torque
from legged_torque.experiments.local_launcher import start_process
from legged_torque.experiments.matrix import command_of
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import part_of, remove_stale_parts, write_whole
from legged_torque.utils.runs import package_versions

Files = dict[str, bytes]  # contents by path below the folder of the results
_BEING_WRITTEN = re.compile(r"\.\d+\.part(/|$)")
_LOG = "output.log"


@dataclass
class News:
    """What has happened on the machine since the last news."""

    place: str  # the machine and its device, for the user: "10.0.0.3 cuda:1"
    status: int | None  # exit status of the process; None while it runs
    log: bytes = b""  # what it has written since
    files: Files = field(default_factory=dict)  # new and changed ones
    refusal: str = ""  # why this machine must not be used


class NodeStep:
    """A process of a step, in a folder of its own; Ray makes an actor of it."""

    def __init__(
        self, words: list[str], files: Files, versions: dict[str, str], device: str, send_every: float
    ) -> None:
        """Start a script, given by name and arguments, unless ``versions`` are not those of this machine.

        Checkpoints of a training that goes on are sent at most every ``send_every`` seconds.
        """
        import ray

        name = ray.util.get_node_ip_address()
        gpus = ray.get_runtime_context().get_accelerator_ids().get("GPU", [])
        self._place = f"{name} cuda:{gpus[0]}" if gpus else f"{name} {device}"
        self._send_every = send_every
        self._process: subprocess.Popen[bytes] | None = None
        self._refusal = difference(f"{name} ({socket.gethostname()})", versions, versions_here())
        if self._refusal:
            return
        temporary = Path(tempfile.gettempdir(), f"legged_torque_{os.getuid()}")
        temporary.mkdir(mode=0o700, exist_ok=True)
        remove_stale_parts(temporary)
        self._root = part_of(temporary / ray.get_runtime_context().get_actor_id())
        self._root.mkdir(mode=0o700)
        write_files(self._root, files)
        self._sent, self._sent_at, self._read = stamps(self._root), time.monotonic(), 0
        with open(self._root / _LOG, "ab") as log:
            self._process = start_process(command_of(words), log, {}, [], cwd=str(self._root))

    def news(self, wait: float) -> News:
        """Return the news after waiting for the process's end for a time [s]; after its end, all that it has left."""
        if self._process is None:
            return News(self._place, None, refusal=self._refusal)
        try:
            status: int | None = self._process.wait(wait)
        except subprocess.TimeoutExpired:
            status = None
        with open(self._root / _LOG, "rb") as log:
            log.seek(self._read)
            text = log.read()
        self._read += len(text)
        return News(self._place, status, text, self._changed_files(status is not None))

    def terminate(self) -> None:
        """Ask the process to end."""
        if self._process is not None:
            self._process.terminate()

    def clean(self) -> None:
        """Remove what is left on this machine."""
        shutil.rmtree(self._root, ignore_errors=True)

    def _changed_files(self, has_ended: bool) -> Files:
        """Return files that are new or have changed, once the process has ended, or with a new checkpoint."""
        if not has_ended and time.monotonic() - self._sent_at < self._send_every:
            return {}
        now = stamps(self._root)
        changed = [name for name, stamp in now.items() if self._sent.get(name) != stamp]
        if not has_ended and not any(Path(name).match("model_*.pt") for name in changed):
            return {}
        self._sent, self._sent_at = now, time.monotonic()
        return read_files(self._root, changed)


def stamps(root: Path) -> dict[str, tuple[int, int]]:
    """Return time and size of all files below a folder, by path, apart from logs and what is being written."""
    found = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        if name != _LOG and not _BEING_WRITTEN.search(name):
            try:
                if path.is_file():
                    found[name] = (path.stat().st_mtime_ns, path.stat().st_size)
            except FileNotFoundError:  # replaced right now
                continue
    return found


def read_files(root: Path, names: list[str]) -> Files:
    """Return the contents of files below a folder; those that are gone by now are left out."""
    files = {}
    for name in names:
        try:
            files[name] = (root / name).read_bytes()
        except FileNotFoundError:
            continue
    return files


def write_files(root: Path, files: Files) -> None:
    """Write files below a folder, checkpoints last, since they make the others count.

    A UserError, and nothing written, if a path leads elsewhere.
    """
    for name in files:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or not path.parts or "\0" in name:
            raise UserError(f"a file of another machine would be written to {name!r}")
    for name in sorted(files, key=lambda name: Path(name).match("model_*.pt")):
        write_whole(root / name, files[name])


def versions_here() -> dict[str, str]:
    """Return what must be the same on all machines: versions of packages, and a digest of this package's code."""
    digest = hashlib.sha256()
    folder, scripts = Path(legged_torque.__file__).parent, legged_torque.SCRIPTS_DIR
    package = [file for file in sorted(folder.rglob("*.py")) if scripts not in file.parents]  # a wheel holds both
    for file in (*package, *sorted(scripts.glob("*.py"))):
        digest.update(file.read_bytes())
    return {**package_versions(), "code of legged_torque": digest.hexdigest()[:12]}


def difference(machine: str, wanted: dict[str, str], found: dict[str, str]) -> str:
    """Return a line on the first version that is another one on a machine; empty if all are the same."""
    for name, version in wanted.items():
        if found.get(name) != version:
            return f"the machine {machine} has {name} {found.get(name, 'not at all')}, this one has {version}"
    return ""
