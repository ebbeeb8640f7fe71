"""The heading of a body, for numpy arrays and torch tensors. Imports neither."""

from typing import Any, TypeAlias

Array: TypeAlias = Any  # a numpy array or a torch tensor


def heading(quat: Array) -> tuple[Array, Array, Array]:
    """Return x and y of the direction to which unit quaternions (w, x, y, z) turn the x axis about the world's z axis.

    That turn is the twist of the swing-twist decomposition, not a yaw of Euler angles. The direction is not normalized:
    the third result is its length, at least 1e-12. It is 0 upside down, where there is no heading. Shapes: (..., 4),
    (...,) each.
    """
    w, z = quat[..., 0], quat[..., 3]
    return w * w - z * z, 2.0 * w * z, (w * w + z * z).clip(min=1e-12)
