"""Resume on several machines: the first process has the run, the others get copies of its files."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from pathlib import Path

from legged_torque.learning import checkpoint
from legged_torque.learning.worlds import worlds_file
from legged_torque.utils import distributed
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import write_whole
from legged_torque.utils.options import Options
from legged_torque.utils.runs import CONFIG_FILE
from legged_torque.utils.task_registry import task_registry


def use_first_run(options: Options) -> None:
    """Write the run and the checkpoint that the first process finds into ``options`` of all processes.

    A process that does not see the same files, on a machine with a file system of its own, gets copies in a temporary
    folder. A UserError in all processes if the first one finds no run.
    """
    device = resolve_device(options.device)
    distributed.join(device)
    digests, problem = {}, ""
    if distributed.rank() == 0:
        try:
            run = task_registry.load_run(options)
            options.checkpoint, checkpoint_file = run.iterations, run.checkpoint.resolve()
            files = (run.folder.resolve() / CONFIG_FILE, checkpoint_file, worlds_file(checkpoint_file))
            digests = {str(file): checkpoint.digest(file) for file in files if file.is_file()}
        except UserError as error:
            problem = str(error)
    digests, options.checkpoint, problem = distributed.from_first((digests, options.checkpoint, problem), device)
    if problem:
        raise UserError(problem)
    folder = Path(next(iter(digests))).parent
    is_missing = any(checkpoint.digest(Path(name)) != digest for name, digest in digests.items())
    if distributed.any_process(is_missing, device):
        mine = {Path(name).name: Path(name).read_bytes() for name in digests} if distributed.rank() == 0 else None
        contents = distributed.from_first(mine, device)
        if is_missing:
            temporary = tempfile.mkdtemp(prefix="legged_torque_")
            atexit.register(shutil.rmtree, temporary, ignore_errors=True)
            folder = Path(temporary) / folder.name
            for name, content in contents.items():
                write_whole(folder / name, content)
    options.load_run = str(folder)
