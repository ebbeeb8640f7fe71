"""Resume on several machines: the first process has the run, the others get copies of its files."""

import atexit
import shutil
import tempfile
from pathlib import Path

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
    contents, problem = dict[Path, bytes](), ""
    if distributed.rank() == 0:
        try:
            run = task_registry.load_run(options)
            options.checkpoint, checkpoint = run.iterations, run.checkpoint.resolve()
            files = (run.folder.resolve() / CONFIG_FILE, checkpoint, worlds_file(checkpoint))
            contents = {file: file.read_bytes() for file in files if file.is_file()}
        except UserError as error:
            problem = str(error)
    contents, options.checkpoint, problem = distributed.from_first((contents, options.checkpoint, problem), device)
    if problem:
        raise UserError(problem)
    folder = next(iter(contents)).parent
    if any(not file.is_file() or file.read_bytes() != content for file, content in contents.items()):
        temporary = tempfile.mkdtemp(prefix="legged_torque_")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        folder = Path(temporary) / folder.name
        for file, content in contents.items():
            write_whole(folder / file.name, content)
    options.load_run = str(folder)
