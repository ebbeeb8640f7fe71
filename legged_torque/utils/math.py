"""Small batched math, in the conventions of MuJoCo: quaternions are (w, x, y, z) and turn body into world vectors."""

from __future__ import annotations

import torch
from torch import Tensor


def quat_rotate_inverse(quat: Tensor, vec: Tensor) -> Tensor:
    """Turn world vectors into body vectors.

    Args:
        quat: Unit quaternions (w, x, y, z) of the bodies in the world. Shape: (N, 4).
        vec: Vectors in the world frame. Shape: (N, 3).

    Returns:
        The vectors in the body frames. Shape: (N, 3).
    """
    w, xyz = quat[:, :1], quat[:, 1:]
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
    cr, sr = torch.cos(0.5 * roll), torch.sin(0.5 * roll)
    cp, sp = torch.cos(0.5 * pitch), torch.sin(0.5 * pitch)
    cy, sy = torch.cos(0.5 * yaw), torch.sin(0.5 * yaw)
    return torch.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        dim=-1,
    )
