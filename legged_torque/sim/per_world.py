"""Giving every world a row of its own in a field of MuJoCo Warp's model."""

import mujoco_warp as mjw
import warp as wp


def expand(model: mjw.Model, name: str, num_envs: int) -> wp.array:
    """Replace a field that all worlds share by one with a row per world, all alike at first, and return it.

    Args:
        model: Model on the device; a field that has been expanded before stays as it is.
        name: Name of the field.
        num_envs: Number of worlds.
    """
    owner = model.opt if name == "gravity" else model
    field = getattr(owner, name)
    if field.shape[0] != num_envs:
        rows = field.numpy().repeat(num_envs, axis=0)
        setattr(owner, name, wp.array(rows, dtype=field.dtype, device=field.device))
    return getattr(owner, name)
