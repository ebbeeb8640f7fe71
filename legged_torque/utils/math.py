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


def quat_from_euler(roll: Tensor, pitch: Tensor, yaw: Tensor) -> Tensor:
    """Return the quaternions of extrinsic rotations about x (roll), then y (pitch), then z (yaw).

    Args:
        roll: Angles in rad. Shape: (N,).
        pitch: Angles in rad. Shape: (N,).
        yaw: Angles in rad. Shape: (N,).

    Returns:
        Unit quaternions (w, x, y, z). Shape: (N, 4).
    """
    half = 0.5 * torch.stack([roll, pitch, yaw])
    (cr, cp, cy), (sr, sp, sy) = torch.cos(half), torch.sin(half)
    cc, ss, sc, cs = cr * cp, sr * sp, sr * cp, cr * sp
    return torch.stack([cc * cy + ss * sy, sc * cy - cs * sy, cs * cy + sc * sy, cc * sy - ss * cy], dim=-1)
