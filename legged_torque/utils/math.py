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


def quat_rotate_yaw(quat: Tensor, vec: Tensor) -> Tensor:
    """Turn vectors (..., 3) about the world's z axis as far as unit quaternions (..., 4) do; axes are broadcast."""
    x, y = rotate_yaw(quat, vec[..., 0], vec[..., 1])
    return torch.stack(torch.broadcast_tensors(x, y, vec[..., 2]), dim=-1)


def rotate_yaw(quat: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Do the same with x and y that are not in one tensor (...,)."""
    w, z = quat[..., 0], quat[..., 3]
    norm = (w.square() + z.square()).clamp(min=1e-12)  # 0 upside down, where there is no heading
    cos, sin = (w.square() - z.square()) / norm, 2.0 * w * z / norm
    return cos * x - sin * y, sin * x + cos * y


def yaw(quat: Tensor) -> Tensor:
    """Return by which angle unit quaternions (..., 4) turn about the world's z axis [rad], -pi to pi. Shape: (...,)."""
    w, z = quat[..., 0], quat[..., 3]
    return torch.atan2(2.0 * w * z, w.square() - z.square())
