"""The state of a training's worlds in files, so that a resumed training gives the same bits as one that never stopped.

``worlds_<n>.pt`` belongs to the checkpoint ``model_<n>.pt``, which knows its digest. It is written before the
checkpoint, and those of earlier checkpoints are removed after it: a kill leaves a pair that fits at any time.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import zlib
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.base_task import BaseTask
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.learning import checkpoint
from legged_torque.utils.config import Section, flat, to_dict
from legged_torque.utils.errors import UserError

_FOREIGN = ("mujoco", "mujoco_warp", "torch", "warp")  # packages whose objects hold no state of a task
_CHUNK = 2**20  # bytes that are compressed together, in a thread


def worlds_file(checkpoint_file: Path) -> Path:
    """Return the file of the worlds that belong to a checkpoint."""
    return checkpoint_file.with_name(checkpoint_file.name.replace("model_", "worlds_"))


def write_worlds(checkpoint_file: Path, content: dict[str, Any]) -> str:
    """Write the worlds that belong to a checkpoint, before it is written; return the digest that it must keep."""
    return checkpoint.write(worlds_file(checkpoint_file), content)


def remove_other_worlds(checkpoint_file: Path) -> None:
    """Remove the worlds of a run's other checkpoints."""
    for file in checkpoint_file.parent.glob("worlds_*.pt"):
        if file != worlds_file(checkpoint_file):
            file.unlink(missing_ok=True)


def read_worlds(checkpoint_file: Path, digest: str | None) -> dict[str, Any]:
    """Return the worlds that belong to a checkpoint which knows their digest; a UserError says why there are none."""
    file = worlds_file(checkpoint_file)
    if not file.is_file():
        raise UserError(f"there is no '{file}': only the last checkpoint of a run keeps them")
    if digest != checkpoint.digest(file):
        raise UserError(f"'{file}' is damaged or belongs to another checkpoint")
    return checkpoint.read(file, "file of worlds", "cpu")


def identity(task: LeggedRobot, evaluation: dict[str, Any]) -> dict[str, str]:
    """Return what must be the same for worlds to go on: the settings, those of ``evaluation`` too, robot and map."""
    model = task.sim.mj_model
    robot = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, robot)
    chosen = {key: evaluation[key] for key in ("num_envs", "perturbation")}
    settings = json.dumps(flat({**to_dict(task.cfg), "evaluation": chosen}))
    ground = task.terrain.map  # a user's own kinds of tiles are no settings
    parts = {"robot": robot} | ({"ground": ground.heights} if ground else {})
    return {"settings": settings, **{name: hashlib.sha256(part.data).hexdigest() for name, part in parts.items()}}


def check_identity(was: dict[str, str], now: dict[str, str]) -> None:
    """Raise a UserError that names the first difference of what :func:`identity` has returned."""
    before, after = json.loads(was["settings"]), json.loads(now["settings"])
    for name in before.keys() | after.keys():
        if before.get(name) != after.get(name):
            raise UserError(f"{name} is {after.get(name)}, was {before.get(name)}")
    if was["robot"] != now["robot"]:
        raise UserError("the robot's model, or the version of MuJoCo, is another one")
    if was.get("ground", now.get("ground")) != now.get("ground"):
        raise UserError("the map of the ground is another one")


def world_tensors(task: BaseTask) -> dict[str, Tensor]:
    """Return every tensor of a task that has a row per world, by the attributes that lead to it.

    These are all tensors that a task keeps from step to step, a user's own included, apart from what
    ``BaseTask.state_dict`` returns. Those that repeat the same memory along an axis cannot change and are left out.
    """
    found: dict[str, Tensor] = {}
    seen = set()

    def visit(value: Any, name: str) -> None:
        if isinstance(value, Tensor):
            if task.num_envs in value.shape and value.numel() and 0 not in value.stride():
                found[name] = value
            return
        parts = _parts(value)
        if parts and id(value) not in seen:
            seen.add(id(value))
            for key, part in parts.items():
                visit(part, f"{name}.{key}" if name else str(key))

    visit(task, "")
    return found


def _parts(value: Any) -> dict[Any, Any]:
    """Return what a container or an object holds, by key or attribute, unless it follows from the rest."""
    if isinstance(value, (dict, TensorDict)):
        return dict(value.items())
    if isinstance(value, (list, tuple)):
        return dict(enumerate(value))
    is_code = inspect.isroutine(value) or inspect.isclass(value) or inspect.ismodule(value)
    is_foreign = type(value).__module__.split(".")[0] in _FOREIGN
    if is_code or is_foreign or isinstance(value, Section):
        return {}
    kept = getattr(value, "__dict__", {})
    return {key: part for key, part in kept.items() if not isinstance(getattr(type(value), key, None), cached_property)}


def pack(tensors: dict[str, Tensor], num_worlds: int) -> dict[str, Any]:
    """Return tensors that have an axis of this many worlds in few bytes, as a file of tensors can hold them.

    A plane is one byte of one number in all worlds. Equal planes, such as those of a view and its base, are kept once,
    and planes of equal weight are compressed together, since the high bytes of floating-point numbers are alike.
    """
    planes = [_planes(tensor, num_worlds) for tensor in tensors.values()]
    data = torch.cat([part for weight in range(8) for part in (p[weight] for p in planes if weight < len(p))])
    rows = data.cpu().numpy()
    places: dict[bytes, int] = {}
    order = [places.setdefault(row.tobytes(), len(places)) for row in rows]
    step = max(_CHUNK // num_worlds, 1)
    unique = list(places)
    with ThreadPoolExecutor() as threads:
        chunks = [b"".join(unique[i : i + step]) for i in range(0, len(unique), step)]
        packed = list(threads.map(_compressed, chunks))
    return {
        "layout": [_layout(name, tensor) for name, tensor in tensors.items()],
        "places": torch.tensor(order, dtype=torch.int32),
        "planes": [torch.frombuffer(bytearray(chunk), dtype=torch.uint8) for chunk in packed],
    }


def unpack(packed: dict[str, Any], tensors: dict[str, Tensor], num_worlds: int) -> None:
    """Write what :func:`pack` has returned into tensors, in place; a UserError, and nothing written, if it misfits."""
    layout = [_layout(name, tensor) for name, tensor in tensors.items()]
    if packed["layout"] != layout:
        names = {entry[0] for entry in packed["layout"] if entry not in layout}
        names |= {entry[0] for entry in layout if entry not in packed["layout"]}
        raise UserError(f"the task keeps other tensors than it did: {', '.join(sorted(names)) or 'in another order'}")
    counts = [tensor.numel() // num_worlds for tensor in tensors.values()]
    sizes = [tensor.element_size() for tensor in tensors.values()]
    places, num_planes = packed["places"].long(), sum(np.multiply(counts, sizes))
    fits = len(places) == num_planes and int(places.min()) >= 0 and int(places.max()) < num_planes
    room = (int(places.max()) + 1) * num_worlds if fits else 0
    data = b"".join(_decompressed(chunk, room) for chunk in packed["planes"]) if fits else b""
    if not fits or len(data) != room:
        raise UserError("they are not as large as they should be")
    planes = torch.frombuffer(bytearray(data), dtype=torch.uint8).view(-1, num_worlds)[places]
    parts: list[list[Tensor]] = [[] for _ in tensors]
    start = 0
    for weight in range(8):
        for part, count, size in zip(parts, counts, sizes, strict=True):
            if weight < size:
                part.append(planes[start : start + count])
                start += count
    for tensor, part in zip(tensors.values(), parts, strict=True):
        axis = tensor.shape.index(num_worlds)
        rows = torch.stack(part, dim=2).permute(1, 0, 2).reshape(-1).view(tensor.dtype)
        rest = [*tensor.shape[:axis], *tensor.shape[axis + 1 :]]
        tensor.copy_(rows.view(num_worlds, *rest).movedim(0, axis))


def _layout(name: str, tensor: Tensor) -> list[Any]:
    """Return what must agree for a tensor to be written back."""
    return [name, str(tensor.dtype), list(tensor.shape)]


def _planes(tensor: Tensor, num_worlds: int) -> Tensor:
    """Return the planes of a tensor. Shape: (bytes of a number, numbers of a world, num_worlds)."""
    rows = tensor.detach().movedim(tensor.shape.index(num_worlds), 0).clone(memory_format=torch.contiguous_format)
    return rows.view(-1).view(torch.uint8).view(num_worlds, -1, tensor.element_size()).permute(2, 1, 0)


def _compressed(chunk: bytes) -> bytes:
    """Return bytes that zlib has compressed; of its strategies this one is the fastest here and leaves the least."""
    stream = zlib.compressobj(1, strategy=zlib.Z_RLE)
    return stream.compress(chunk) + stream.flush()


def _decompressed(chunk: Tensor, most: int) -> bytes:
    """Return what was compressed; a UserError if it is damaged or larger than it can be."""
    stream = zlib.decompressobj()
    try:
        data = stream.decompress(chunk.numpy().tobytes(), most)
    except zlib.error as error:
        raise UserError(f"they cannot be decompressed: {error}") from None
    if not stream.eof:
        raise UserError("they are larger than they should be")
    return data
