"""Small batched math, in the conventions of MuJoCo: quaternions are (w, x, y, z) and turn body into world vectors."""

from __future__ import annotations

import torch
from torch import Tensor


def quat_rotate_inverse(quat: Tensor, vec: Tensor) -> Tensor:
    """Turn world vectors into body vectors.

    Args:
        quat: Unit quaternions (w, x, y, z) of the bodies in the world. Shape: (..., 4).
        vec: Vectors in the world frame. Shape: (..., 3), of as many axes; those of size 1 are broadcast.

    Returns:
        The vectors in the body frames. Shape: (..., 3).
    """
    w, xyz = quat[..., :1], quat[..., 1:]
    t = 2.0 * torch.linalg.cross(xyz, vec)
    return vec - w * t + torch.linalg.cross(xyz, t)
