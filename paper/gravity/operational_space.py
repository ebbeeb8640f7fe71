r"""The contact-consistent operational space of Park and Khatib (eqs. 2 to 6, 9 and 11), in pure batched torch.

With the joint space dynamics A qacc + h = S_k^T Gamma + J_c^T f_c, where h = C + g, and with contact points that do not
accelerate, J_c qacc + dJ_c/dt qvel = 0, it follows that

    qacc = N_c A^-1 (S_k^T Gamma - h) - J_c_bar dJ_c/dt qvel.

Contact forces are those of the ground on the robot; the paper's eq. 11 has the opposite sign.

All states have the same candidate contacts, and a mask of those that touch the ground. The rows of J_c of the others
are zero, and ones on their part of the diagonal keep J_c A^-1 J_c^T invertible; nothing couples them with the rest, so
results are exactly those of matrices of the touching contacts alone. Contacts may change from step to step and differ
from state to state, and no matrix changes its size.

Floating point type and device are those of the arguments; nothing waits for the host.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

TRUNK_DOFS = 6  # virtual joints in front of the actuated ones, which S_k removes


@dataclass
class ContactSpace:
    """The space of contacts, and the motions that leave all contacts at rest."""

    jacobian: Tensor  # J_c (eq. 9) with rows of zeros where nothing touches. Shape: (n, 3 k, nv)
    inertia: Tensor  # Lambda_c = (J_c A^-1 J_c^T)^-1, zero where nothing touches. Shape: (n, 3 k, 3 k)
    inverse: Tensor  # J_c_bar = A^-1 J_c^T Lambda_c, dynamically consistent inverse of J_c. Shape: (n, nv, 3 k)
    projector: Tensor  # N_c = 1 - J_c_bar J_c, onto motions with all contacts at rest. Shape: (n, nv, nv)
    mobility: Tensor  # N_c A^-1, symmetric: acceleration per force with the contacts held. Shape: (n, nv, nv)
    bias: Tensor  # dJ_c/dt qvel [m/s^2], zero where nothing touches. Shape: (n, 3 k)


@dataclass
class TaskSpace:
    """The contact-consistent dynamics of a task x: Lambda d^2x/dt^2 + mu + p = F (eq. 2)."""

    inertia: Tensor  # Lambda = (J N_c A^-1 J^T)^-1. Shape: (n, m, m)
    coriolis: Tensor  # mu, Coriolis and centrifugal forces, those that hold the contacts included. Shape: (n, m)
    gravity: Tensor  # p, gravity forces. Shape: (n, m)
    inverse: Tensor  # J_bar^T = Lambda J N_c A^-1, which turns generalized forces into F. Shape: (n, m, nv)


def invert(matrix: Tensor) -> Tensor:
    """Return the inverses of symmetric positive definite matrices. Shape: (..., m, m)."""
    # It is zero for a matrix that rounding made indefinite: in single precision, that of a stretched leg.
    factor, info = torch.linalg.cholesky_ex(matrix)
    inverse = inverse_triangle(factor)
    return torch.where((info > 0)[..., None, None], 0.0, inverse.mT @ inverse)


def inverse_triangle(factor: Tensor) -> Tensor:
    """Return inverses of lower triangular matrices; unlike cholesky_inverse in CUDA graphs too. Shape: (..., m, m)."""
    return torch.linalg.solve_triangular(factor, _eye(factor), upper=False)


def contact_space(inertia: Tensor, jacobians: Tensor, bias: Tensor, mask: Tensor) -> ContactSpace:
    """Compute the space of the contacts in ``mask`` (eq. 9).

    Shapes: joint space inertia A (n, nv, nv), J_c of all candidate contacts (n, k, 3, nv), ``bias`` dJ_c/dt qvel
    [m/s^2] (n, k, 3), mask of contacts that touch the ground (n, k), bool.
    """
    rows = mask.repeat_interleave(3, dim=1)
    jacobian = torch.where(rows.unsqueeze(2), jacobians.flatten(1, 2), 0.0)
    root = inverse_triangle(torch.linalg.cholesky_ex(inertia).L)
    half = root @ jacobian.mT
    free = invert(half.mT @ half + torch.diag_embed((~rows).to(inertia)))
    lambda_c = torch.where(rows.unsqueeze(1) & rows.unsqueeze(2), free, 0.0)
    inverse_inertia = root.mT @ root
    inverse = inverse_inertia @ jacobian.mT @ lambda_c
    projector = _eye(inertia) - inverse @ jacobian
    mobility = projector @ inverse_inertia
    return ContactSpace(jacobian, lambda_c, inverse, projector, mobility, torch.where(rows, bias.flatten(1), 0.0))


def task_space(contacts: ContactSpace, jacobian: Tensor, coriolis: Tensor, gravity: Tensor) -> TaskSpace:
    """Compute the contact-consistent dynamics of a task whose dJ/dt qvel is zero, such as the trunk's pose (eq. 2)."""
    # Shapes of J, Coriolis and centrifugal forces C, and gravity forces g: (n, m, nv), (n, nv), (n, nv).
    moved = jacobian @ contacts.mobility
    inertia = invert(moved @ jacobian.mT)
    inverse = inertia @ moved
    held = inertia @ (jacobian @ apply(contacts.inverse, contacts.bias).unsqueeze(-1))
    return TaskSpace(inertia, apply(inverse, coriolis) + held.squeeze(-1), apply(inverse, gravity), inverse)


def torque_map(task: TaskSpace, joints: Tensor, damping: float) -> Tensor:
    """Return J_k^T, which turns task forces F into the least joint torques that exert them (eq. 4) (n, nv - 6, m).

    J_bar^T S_k^T maps torques to forces F; J_k^T is its pseudo-inverse. Torques that only press contacts against each
    other exert no F, and the least torques have no such part.

    Only ``joints`` (n, nv - 6), bool, serve the task; others have rows of zeros. ``damping`` is Tikhonov's, relative to
    the mean square singular value: with fewer than three contacts some forces F can hardly be exerted.
    """
    exerted = torch.where(joints.unsqueeze(1), task.inverse[:, :, TRUNK_DOFS:], 0.0)
    gram = exerted @ exerted.mT
    mean = gram.diagonal(dim1=1, dim2=2).mean(dim=1) + torch.finfo(gram.dtype).eps
    damped = gram + damping * mean[:, None, None] * _eye(gram)
    return exerted.mT @ invert(damped)


def task_force(task: TaskSpace, acceleration: Tensor) -> Tensor:
    """Return F = Lambda f* + mu + p (eqs. 2 and 4) for f*, the wanted acceleration [m/s^2, rad/s^2]. Shapes: (n, m)."""
    return apply(task.inertia, acceleration) + task.coriolis + task.gravity


def posture_torques(task: TaskSpace, to_torques: Tensor, torques: Tensor) -> Tensor:
    """Return N^T Gamma_0, the part of posture torques that does not disturb the task (eq. 5) [N m] (n, nv - 6)."""
    # N^T = 1 - J_k^T J_bar^T S_k^T, with J_k^T from torque_map
    return torques - apply(to_torques, apply(task.inverse[:, :, TRUNK_DOFS:], torques))


def contact_forces(contacts: ContactSpace, torques: Tensor, bias_forces: Tensor) -> Tensor:
    """Return the contact forces f_c that joint torques cause (eq. 11), by the ground on the robot.

    f_c = J_c_bar^T (h - S_k^T Gamma) - Lambda_c dJ_c/dt qvel = -(J_c_bar^T S_k^T Gamma - mu_c - p_c).

    Gamma are the torques [N m] (n, nv - 6), h Coriolis, centrifugal and gravity forces (n, nv). Forces are in the world
    frame [N], zero where nothing touches. Shape: (n, k, 3).
    """
    applied = torch.nn.functional.pad(torques, (TRUNK_DOFS, 0)) - bias_forces
    forces = -apply(contacts.inverse.mT, applied) - apply(contacts.inertia, contacts.bias)
    return forces.unflatten(1, (-1, 3))


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """Multiply matrices with vectors. Shapes: (n, rows, columns) and (n, columns) to (n, rows)."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _eye(matrix: Tensor) -> Tensor:
    """Return the identity of a square matrix's size, type and device."""
    return torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device).expand_as(matrix)
