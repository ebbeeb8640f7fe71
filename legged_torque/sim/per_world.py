"""Giving every world a row of its own in a field of MuJoCo Warp's model."""

import mujoco_warp as mjw
import warp as wp


def owner(model: mjw.Model, name: str) -> mjw.Model | mjw.Option:
    """Return the object that has a field: the model, or its options for gravity."""
    return model.opt if name == "gravity" else model


def expand(model: mjw.Model, name: str, num_envs: int) -> None:
    """Replace a field that all worlds share by one with a row per world, all alike at first; others stay."""
    field = getattr(owner(model, name), name)
    if field.shape[0] != num_envs:
        rows = field.numpy().repeat(num_envs, axis=0)
        setattr(owner(model, name), name, wp.array(rows, dtype=field.dtype, device=field.device))
