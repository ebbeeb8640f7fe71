"""The state of a training's worlds in files, so that a resumed training gives the same bits as one that never stopped.

``worlds_<n>.pt`` belongs to the checkpoint ``model_<n>.pt``, which keeps its digest. It is written before the
checkpoint, and those of earlier checkpoints are removed after it: a kill leaves a pair that fits at any time.
"""

import json
from pathlib import Path
from typing import Any

from legged_torque.learning import checkpoint
from legged_torque.learning.protocols import Stateful
from legged_torque.utils import distributed
from legged_torque.utils.buffers import check_state
from legged_torque.utils.display import warn
from legged_torque.utils.errors import UserError
from legged_torque.utils.policies import sha256
from legged_torque.utils.runs import checkpoint_number


class Worlds:
    """Keeps the state of all processes of a training that is not in its checkpoints."""

    def __init__(self, task: Any, learner: Any, evaluation: dict[str, Any], others: list[Stateful]) -> None:
        """Take task, learner, the settings ``evaluation``, and other objects whose state belongs to the worlds."""
        self._task, self._others = task, others
        owners = {"learner": learner} if hasattr(learner, "world_state_dict") else {}
        self._owners = owners | {"worlds": task}  # a learner's may not fit, and then all worlds start anew
        self._evaluation = {key: evaluation[key] for key in ("num_envs", "perturbation")}

    def gather(self) -> dict[str, Any]:
        """Return the worlds of all processes in the first one, copied to the host; nothing in the others.

        Nothing, too, of a task that cannot keep its worlds.
        """
        if not hasattr(self._task, "identity"):
            return {}
        state = {name: owner.world_state_dict() for name, owner in self._owners.items()}
        for other in self._others:
            state |= other.state_dict()
        processes = [checkpoint.on_host(each) for each in distributed.gather_tensors(state, self._task.device)]
        return {"identity": json.dumps(self._identity()), "processes": processes} if processes else {}

    def write(self, checkpoint_file: Path, content: dict[str, Any]) -> str:
        """Write what :meth:`gather` returned, before the checkpoint that it belongs to, and return its digest.

        Empty where worlds cannot be kept: the checkpoint is worth more.
        """
        try:
            return checkpoint.write(worlds_file(checkpoint_file), content) if content else ""
        except UserError as error:
            warn(f"worlds would start anew in a resumed run: {error}")
            return ""

    def read(self, checkpoint_file: Path, digest: str | None) -> None:
        """Continue with the worlds of a checkpoint, which has their digest; a UserError if they do not fit."""
        file = worlds_file(checkpoint_file)
        if not hasattr(self._task, "identity"):
            raise UserError(f"{type(self._task).__name__} does not keep them")
        if not file.is_file():
            raise UserError(f"there is no '{file}': only the last checkpoint of a run keeps them")
        if digest != sha256(file):
            raise UserError(f"'{file}' is damaged or belongs to another checkpoint")
        content = checkpoint.load(file, "file of worlds", "cpu")
        if "identity" not in content:
            raise UserError(f"'{file}' was written by another version")
        check_identity(json.loads(content["identity"]), json.loads(json.dumps(self._identity())))
        processes = content["processes"]
        if len(processes) != distributed.world_size():
            raise UserError(f"{len(processes)} processes have trained, now there are {distributed.world_size()}")
        state = processes[distributed.rank()]
        try:
            check_state(self._task.world_state_dict(), state["worlds"])  # before anything goes on
            for other in self._others:
                other.load_state_dict(state)
            for name, owner in self._owners.items():
                owner.load_world_state_dict(state[name])
        except (RuntimeError, KeyError, TypeError, ValueError) as error:
            raise UserError(f"'{file}' does not fit: {checkpoint.last_line(error)}") from None

    def _identity(self) -> dict[str, Any]:
        """Return what must be the same for worlds to go on: the task's identity, and settings of ``evaluation``."""
        identity = self._task.identity()
        settings = {f"evaluation.{name}": value for name, value in self._evaluation.items()}
        return {**identity, "settings": {**identity["settings"], **settings}}


def worlds_file(checkpoint_file: Path) -> Path:
    """Return the file of the worlds that belong to a checkpoint."""
    return checkpoint_file.with_name(checkpoint_file.name.replace("model_", "worlds_"))


def remove_older_worlds(checkpoint_file: Path) -> None:
    """Remove the worlds of a run's earlier checkpoints; those of a later one may be there before it."""
    for file in checkpoint_file.parent.glob("worlds_*.pt"):
        number = file.stem.removeprefix("worlds_")
        if number.isdecimal() and int(number) < checkpoint_number(checkpoint_file):
            file.unlink(missing_ok=True)


def check_identity(was: dict[str, Any], now: dict[str, Any]) -> None:
    """Raise a UserError that names the first difference between two identities of a task."""
    for name in was["settings"].keys() | now["settings"].keys():
        before, after = (identity["settings"].get(name) for identity in (was, now))
        if before != after:
            raise UserError(f"{name} is {after}, was {before}")
    for name in was.keys() | now.keys():
        if was.get(name) != now.get(name):
            raise UserError(f"the {name} is another one")
