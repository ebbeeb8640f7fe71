"""Tasks from outside the package: files that a command line names, and entry points of installed packages.

Both run their author's code, so the user names or installs them; nothing that a run or an experiment has written does.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import importlib.util
import sys
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from legged_torque.utils.errors import UserError

ENTRY_POINTS = "legged_torque.tasks"
"""Group of the entry points, each of a module that registers tasks."""


def import_task_files(tasks: dict[str, Any], files: Iterable[str | Path]) -> None:
    """Import Python files that register tasks, each once; ``tasks`` are those of the registry, by name.

    A file is imported by its name, and its folder becomes the last place to import from: it may use files next to it,
    and settings may name its classes, ``"my_task:MyRobot"``. A UserError says why a file cannot be used.
    """
    for file in map(Path, files):
        name, path = file.stem, file.absolute()
        if not path.is_file() or path.suffix != ".py" or not name.isidentifier():
            raise UserError(f"--task_file takes a Python file with the name of a module, not '{file}'")
        other = _file_of_module(name)
        if other and Path(other).resolve() != path.resolve():
            raise UserError(f"'{file}' cannot be imported: there is another module '{name}'; rename the file")
        if name not in sys.modules:
            sys.path.append(str(path.parent))
            with _adding_tasks(tasks, f"'{file}'"):
                importlib.import_module(name)


def import_installed_tasks(tasks: dict[str, Any]) -> None:
    """Import the :data:`ENTRY_POINTS` of installed packages; ``tasks`` are those of the registry, by name.

    A broken one does not affect the others: a line on standard error says what is wrong, and its tasks are missing.
    """
    for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
        if point.module not in sys.modules:
            try:
                with _adding_tasks(tasks, f"the entry point '{point.name} = {point.value}'"):
                    point.load()
            except UserError as error:
                print(f"Note: {error}", file=sys.stderr)


def _file_of_module(name: str) -> str | None:
    """Return the file of a module that is imported or can be; None if there is none, or just a folder."""
    if name in sys.modules:
        return getattr(sys.modules[name], "__file__", None) or name  # Python's own have none
    spec = importlib.util.find_spec(name)
    return spec.origin if spec else None


@contextlib.contextmanager
def _adding_tasks(tasks: dict[str, Any], source: str) -> Iterator[None]:
    """Context for an import that registers tasks; a UserError says in which line it fails, or that it registers none.

    After an error, the tasks are as before.
    """
    before = dict(tasks)
    try:
        yield
        if len(tasks) == len(before):
            raise UserError("it registers no task: it must call task_registry.register")
    except (Exception, SystemExit) as error:  # some read the command line themselves, and end the process
        tasks.clear()
        tasks.update(before)
        if isinstance(error, UserError):
            raise UserError(f"{source}: {error}") from error
        last = traceback.extract_tb(error.__traceback__)[-1]
        file, line = (error.filename, error.lineno) if isinstance(error, SyntaxError) else (last.filename, last.lineno)
        place = f"line {line} of '{Path(file or '?').name}'"
        raise UserError(f"{source} cannot be imported: {place}: {type(error).__name__}: {error}") from error
