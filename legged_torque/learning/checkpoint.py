"""Files of tensors: written atomically, checked, and read without running code in them."""

import hashlib
import io
import pickle
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map_only

from legged_torque.utils.errors import UserError
from legged_torque.utils.files import is_whole_archive, write_whole
from legged_torque.utils.limits import NotNegative, Number, check_value

PLAIN = {"Tensor", "Parameter", "str", "int", "float", "bool", "NoneType"}
"""Types that files may hold, in dictionaries and lists; others would not load without running code."""


class Background:
    """A thread that writes files while training goes on (asynchronous checkpointing), one after the other.

    Python ends only after its work, also if a training is interrupted; errors are silent then.
    """

    def __init__(self) -> None:
        """Prepare; nothing runs yet."""
        self._pool = ThreadPoolExecutor(1)
        self._work: Future[None] | None = None
        self._then: Callable[[], object] = lambda: None

    def start(self, work: Callable[[], None], then: Callable[[], object]) -> None:
        """Begin a piece of work, if that before is finished; ``then`` is called by :meth:`poll` when it is done."""
        self._work, self._then = self._pool.submit(work), then

    def poll(self) -> None:
        """Call what follows the work if that is done; an error of the work is raised here."""
        if self._work and self._work.done():
            work, self._work = self._work, None
            work.result()
            self._then()

    def finish(self) -> None:
        """Wait for the work, and do as :meth:`poll` does."""
        if self._work:
            wait([self._work])
            self.poll()


def on_host(content: Any) -> Any:
    """Return nested containers with copies of all tensors, in the memory of the host; waits once for all of them."""
    copies = tree_map_only(Tensor, lambda tensor: tensor.detach().to("cpu", non_blocking=True, copy=True), content)
    if torch.cuda.is_initialized():  # in a training on a CPU, it would start CUDA
        torch.cuda.synchronize()
    return copies


def cloned(state: dict[str, Any]) -> dict[str, Any]:
    """Return a state with each tensor in memory of its own."""
    return tree_map_only(Tensor, Tensor.clone, state)


def write(file: Path, content: dict[str, Any]) -> str:
    """Write tensors and plain values, and return the SHA-256 of the file.

    The file is either complete or absent at any time; a UserError if it cannot be written, or not be loaded again.
    """
    if other := {type(part).__name__ for part in tree_leaves(content)} - PLAIN:
        kinds = ", ".join(sorted(other))
        raise UserError(f"'{file}' cannot be written: it takes tensors and plain values only, not {kinds}")
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_whole(file, buffer.getvalue())
    return hashlib.sha256(buffer.getvalue()).hexdigest()


def load(file: Path, what: str, device: str) -> Any:
    """Return what :func:`write` has written, on a device; a UserError names ``what`` if the file is broken."""
    if not is_whole_archive(file):
        raise UserError(f"'{file}' is not a readable {what}: it is damaged, or not written by this library")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns of an archive of TorchScript
            return torch.load(file, weights_only=True, map_location=device)
    except pickle.UnpicklingError:
        raise UserError(f"'{file}' is not a readable {what}: it holds more than tensors and plain values") from None
    except Exception as error:  # torch raises about anything for other files
        raise UserError(f"'{file}' is not a readable {what}: {last_line(error)}") from None


def read(file: Path, what: str, device: str) -> Any:
    """Return what :func:`load` does; a UserError also if it holds a number that is not finite."""
    content = load(file, what, device)
    try:
        bad = not_finite(content)
    except (RuntimeError, MemoryError) as error:  # nested too deeply, or a tensor of few numbers, repeated many times
        raise UserError(f"'{file}' is not a readable {what}: {last_line(error)}") from None
    if bad:
        raise UserError(f"'{file}' is not a usable {what}: {bad} holds numbers that are not finite")
    return content


def write_actor(file: Path, folder: Path) -> dict[str, Any]:
    """Write what playing needs of a checkpoint to another folder, and return it: the actor and counters."""
    content = read(file, "checkpoint", "cpu")
    kept = {key: content[key] for key in ("actor_state_dict", "iter", "infos")}
    write(folder / file.name, kept)
    return kept


def check_counters(state: dict[str, Any], file: str) -> None:
    """Raise a UserError if the counters of a checkpoint are not numbers."""
    try:
        if not isinstance(state, dict) or not isinstance(state.get("infos"), dict):
            raise UserError("it lacks the entry infos")
        counters = state["infos"] | {"iter": state["iter"]}
        for name, hint in {"iter": Number, "total_timesteps": Number, "seconds": NotNegative}.items():
            check_value(name, counters[name], hint)
    except UserError as error:
        raise UserError(f"'{file}' is not a usable checkpoint: {error}") from None


def not_finite(content: Any, name: str = "") -> str:
    """Return the name of the first tensor in nested containers that is not finite; empty if there is none."""
    if isinstance(content, Tensor):
        is_finite = not content.is_floating_point() or bool(torch.isfinite(content).all())
        return "" if is_finite else name or "the tensor"
    parts = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return next(filter(None, (not_finite(part, f"{name}.{key}" if name else str(key)) for key, part in parts)), "")


def last_line(error: Exception) -> str:
    """Return the line of an error's message that says most."""
    return str(error).strip().splitlines()[-1].strip() if str(error).strip() else type(error).__name__
