"""Files that are complete or absent, and errors of the system told by name."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

from legged_torque.utils.errors import UserError

_PART = re.compile(r"\.(\d+)\.part$")  # end of the name of what is being written: the process's id


@contextlib.contextmanager
def told_by_name(path: Path) -> Iterator[None]:
    """Let a full disk, a read-only folder and the like be a UserError that names what cannot be written."""
    try:
        yield
    except OSError as error:
        raise UserError(f"cannot write '{path}': {error.strerror or error}") from None


def part_of(path: Path) -> Path:
    """Return where this process writes what will become a file or folder."""
    return path.with_name(f"{path.name}.{os.getpid()}.part")


def write_whole(file: Path, content: bytes) -> None:
    """Write a file that is complete or absent whenever the process or the machine ends; a UserError if it cannot."""
    part = part_of(file)
    with told_by_name(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.exists() and not file.is_file():  # a device such as /dev/null is not to be replaced
            file.write_bytes(content)
            return
        try:
            with part.open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(part, file)
        finally:
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def held(lock: Path) -> Iterator[None]:
    """Hold a lock file when others have let it go; a UserError if it cannot be written. It stays: others may wait."""
    with told_by_name(lock):
        lock.parent.mkdir(parents=True, exist_ok=True)
        stream = lock.open("ab")
    with stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield


def remove_stale_parts(folder: Path) -> None:
    """Remove what processes that have been killed were writing in a folder."""
    for path in folder.glob("*.part"):
        writer = _PART.search(path.name)
        if writer and not is_running(int(writer[1])):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def is_running(process: int) -> bool:
    """Return whether there is a process of this id."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's, or no id at all
        return True
    return True


def is_whole_archive(file: Path) -> bool:
    """Return whether a file is a zip archive, as torch writes, whose parts all have their checksums."""
    try:
        with zipfile.ZipFile(file) as archive:
            has_folders = any(part.external_attr for part in archive.infolist())  # torch writes none, and reads no data
            return archive.testzip() is None and not has_folders
    except Exception:  # zipfile raises about anything for a damaged file
        return False
