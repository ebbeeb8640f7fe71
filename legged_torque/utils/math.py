"""Small batched math, in the conventions of MuJoCo: quaternions are (w, x, y, z) and turn body into world vectors."""

from __future__ import annotations

import torch
from torch import Tensor


def quat_rotate_inverse(quat: Tensor, vec: Tensor) -> Tensor:
    """Turn world vectors (..., 3) into the frames of bodies with unit quaternions (..., 4).

    Both have as many axes; those of size 1 are broadcast. Shape: (..., 3).
    """
    w, xyz = quat[..., :1], quat[..., 1:]
    t = 2.0 * torch.linalg.cross(xyz, vec)
    return vec - w * t + torch.linalg.cross(xyz, t)
