"""Small batched math, in the conventions of MuJoCo: quaternions are (w, x, y, z) and turn body into world vectors."""

import torch
from torch import Tensor

from legged_torque.utils.heading import heading


def quat_multiply(first: Tensor, second: Tensor) -> Tensor:
    """Return the quaternions (..., 4) that turn as ``second``, then as ``first`` does; axes are broadcast."""
    w, xyz, other_w, other = first[..., :1], first[..., 1:], second[..., :1], second[..., 1:]
    real = w * other_w - (xyz * other).sum(dim=-1, keepdim=True)
    return torch.cat([real, w * other + other_w * xyz + torch.linalg.cross(xyz, other)], dim=-1)


def quat_rotate(quat: Tensor, vec: Tensor) -> Tensor:
    """Turn vectors (..., 3) of bodies with unit quaternions (..., 4) into the world's frame, see the inverse."""
    return quat_rotate_inverse(torch.cat([-quat[..., :1], quat[..., 1:]], dim=-1), vec)


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
    """Turn vectors like :func:`quat_rotate_yaw`, with x and y in tensors of their own (...,)."""
    x_ahead, y_ahead, length = heading(quat)
    cos, sin = x_ahead / length, y_ahead / length
    return cos * x - sin * y, sin * x + cos * y


def yaw(quat: Tensor) -> Tensor:
    """Return by which angle unit quaternions (..., 4) turn about the world's z axis [rad], -pi to pi. Shape: (...,)."""
    x_ahead, y_ahead, _ = heading(quat)
    return torch.atan2(y_ahead, x_ahead)
