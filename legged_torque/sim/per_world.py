"""Giving every world a row of its own in a field of MuJoCo Warp's model."""

from collections.abc import Sequence

import mujoco_warp as mjw
import warp as wp

from legged_torque.utils.errors import UserError, unknown_name


def owner(model: mjw.Model, name: str) -> mjw.Model | mjw.Option:
    """Return the object that has a field: the model, or its options for gravity."""
    return model.opt if name == "gravity" else model


def check_fields(model: mjw.Model, names: Sequence[str], allowed: Sequence[str] | None) -> None:
    """Raise a UserError for a field that the model lacks or that is not among those that the fused step reads."""
    for name in names:
        if not isinstance(getattr(owner(model, name), name, None), wp.array):
            raise unknown_name("field of the model", name, allowed or vars(model))
        if allowed is not None and name not in allowed:
            raise UserError(f"sim.engine 'fused' does not read '{name}' per world; it reads: {', '.join(allowed)}")


def expand(model: mjw.Model, name: str, num_envs: int) -> None:
    """Replace a field that all worlds share by one with a row per world, all alike at first; others stay."""
    field = getattr(owner(model, name), name)
    if field.shape[0] != num_envs:
        rows = field.numpy().repeat(num_envs, axis=0)
        setattr(owner(model, name), name, wp.array(rows, dtype=field.dtype, device=field.device))
