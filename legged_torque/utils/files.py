"""Files that are complete or absent, errors that name the file, and paths that name no folder of one machine."""

import contextlib
import fcntl
import importlib.util
import json
import math
import os
import re
import shutil
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from legged_torque.utils.errors import UserError


def importable(file: Path, option: str) -> str:
    """Return the name of the module that a Python file is, with its folder as the last place to import from.

    A UserError says why the file, which was given as an ``option``, cannot be imported.
    """
    name, path = file.stem, file.absolute()
    if not path.is_file():
        raise UserError(f"{option}: there is no file '{file}'")
    if path.suffix != ".py" or not name.isidentifier():
        raise UserError(f"{option} takes a Python file with the name of a module, not '{file}'")
    if name in sys.modules:
        other = getattr(sys.modules[name], "__file__", None) or name  # Python's own have none
    else:
        spec = importlib.util.find_spec(name)
        other = spec.origin if spec else None  # of a folder, too
    if other and Path(other).resolve() != path.resolve():
        raise UserError(f"'{file}' cannot be imported: there is another module '{name}'; rename the file")
    if name not in sys.modules:
        sys.path.append(str(path.parent))
    return name


@contextlib.contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Turn a full disk, a read-only folder and the like into a UserError that names the file."""
    try:
        yield
    except OSError as error:
        raise UserError(f"cannot write '{path}': {error.strerror or error}") from None


def part_of(path: Path) -> Path:
    """Return the path at which this process, of this machine, writes a file or folder until it is finished."""
    return path.with_name(f"{path.name}.{os.uname().nodename}.{os.getpid()}.part")


def write_whole(file: Path, content: bytes | str) -> None:
    """Write a file that is complete or absent whenever the process or the machine ends; a UserError if it cannot."""
    content = content.encode() if isinstance(content, str) else content
    part = part_of(file)
    with write_errors(file):
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


def append_whole(file: Path, text: str) -> None:
    """Append to a file; a UserError if it cannot be written, and then it has no part of the text."""
    rest = text.encode()
    with write_errors(file), file.open("ab", buffering=0) as stream:
        size = stream.tell()
        try:
            while rest:
                rest = rest[stream.write(rest) :]
        except OSError:
            stream.truncate(size)
            raise


def write_json(file: Path, value: Any) -> None:
    """Write a JSON file by :func:`write_whole`; numbers that are not finite, which JSON does not know, become null."""

    def finite(part: Any) -> Any:
        if isinstance(part, (dict, list, tuple)):
            return {k: finite(v) for k, v in part.items()} if isinstance(part, dict) else [finite(v) for v in part]
        return None if isinstance(part, float) and not math.isfinite(part) else part

    write_whole(file, json.dumps(finite(value), indent=1) + "\n")


def read_data(file: Path, keys: set[str], script: str) -> dict[str, Any]:
    """Return the JSON object with at least these keys that ``script`` has written; a UserError if it is none."""
    if not file.is_file():  # a device might never end
        raise UserError(f"cannot read '{file}': there is no such file")
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # nested too deeply
        raise UserError(f"cannot read '{file}': {error}") from None
    if not isinstance(data, dict) or not keys <= data.keys():
        raise UserError(f"'{file}' is not a file that {script} has written")
    return data


@contextlib.contextmanager
def held(lock: Path) -> Iterator[None]:
    """Hold a lock file, after others have released it; a UserError if it cannot be written. The file is kept."""
    with write_errors(lock):
        lock.parent.mkdir(parents=True, exist_ok=True)
        stream = lock.open("ab")
    with stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield


def remove_stale_parts(folder: Path) -> None:
    """Remove the unfinished files of killed processes of this machine from a folder; others may share it."""
    for path in folder.glob("*.part"):
        writer = re.search(rf"\.{re.escape(os.uname().nodename)}\.(\d+)\.part$", path.name)
        try:
            os.kill(int(writer[1]) if writer else os.getpid(), 0)
        except ProcessLookupError:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
        except (OSError, OverflowError):  # of another user, or no process's number at all
            continue


def is_whole_archive(file: Path) -> bool:
    """Return whether a file is a zip archive, as torch writes, whose parts all have their checksums."""
    if not file.is_file():  # a pipe or a device might never end
        return False
    try:
        with zipfile.ZipFile(file) as archive:
            parts = archive.infolist()
            is_compressed = sum(part.file_size for part in parts) > file.stat().st_size  # which torch's are not
            has_folders = any(part.external_attr for part in parts)  # torch writes none, and reads no data
            return not is_compressed and not has_folders and archive.testzip() is None
    except Exception:  # zipfile raises about anything for a damaged file
        return False


def path_inside(folder: Path, name: str) -> Path:
    """Return a path in a folder, which may be a stranger's; a UserError if it leads out of it by a link."""
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise UserError(f"'{path}' leads out of '{folder}' by a link, and is not written to")
    return path


def portable_path(path: str | Path) -> str:
    """Return a path relative to the current folder; only its name if it is absolute and lies elsewhere."""
    path = Path(path)
    if not path.is_absolute():
        return str(path)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else path.name


def without_machine(value: Any) -> Any:
    """Return settings with every absolute path, alone or as KEY=PATH, replaced by :func:`portable_path`."""
    if isinstance(value, dict):
        return {key: without_machine(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [without_machine(entry) for entry in value]
    if not isinstance(value, str):
        return value
    key, equals, path = ("", "", value) if Path(value).is_absolute() else value.partition("=")
    return key + equals + portable_path(path) if Path(path).is_absolute() else value
