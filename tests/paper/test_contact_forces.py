"""The batched solver for contact forces against bounds on the optimum and numbers found by hand."""

import numpy as np
import pytest
import torch

from legged_torque.paper.gravity.contact_forces import ForceDistribution, ForceLimits
from legged_torque.utils.errors import UserError

LIMITS = ForceLimits(friction=0.6, lowest=4.0, highest=160.0)
ARM = 0.2
REGULARIZATION = 1e-2
CONVERGED = 30
"""Iterations after which double precision is exhausted."""


def grasp_matrix(points):
    """The wrench about the origin of unit forces at points (n, k, 3)."""
    n, k, _ = points.shape
    axes = torch.eye(3, dtype=points.dtype).expand(n, k, 3, 3)
    moments = torch.linalg.cross(points.unsqueeze(2).expand(n, k, 3, 3), axes, dim=-1)
    return torch.cat([axes, moments], dim=3).permute(0, 3, 1, 2).flatten(2)


def random_problems(count=300):
    """Feet around a trunk, wrenches and reference forces that many of them cannot bear, and any contact state."""
    generator = torch.Generator().manual_seed(0)
    feet = torch.tensor([[0.2, -0.13, -0.3], [0.2, 0.13, -0.3], [-0.2, -0.13, -0.3], [-0.2, 0.13, -0.3]])
    points = feet + 0.05 * torch.randn(count, 4, 3, generator=generator)
    wrench = torch.tensor([0.0, 0.0, 120.0, 0.0, 0.0, 0.0]) + torch.randn(count, 6, generator=generator) * torch.tensor(
        [60.0, 60.0, 80.0, 15.0, 15.0, 5.0]
    )
    reference = torch.tensor([0.0, 0.0, 30.0]) + 40.0 * torch.randn(count, 4, 3, generator=generator)
    mask = torch.rand(count, 4, generator=generator) < 0.75
    return grasp_matrix(points.double()), wrench.double(), reference.double(), mask


def cost_and_gradient(problem, forces):
    """The documented objective of each problem, halved, and its gradient by the forces, masked ones left out."""
    grasp, wrench, reference, mask = (part.numpy().astype(float) for part in problem)
    forces = forces.numpy().astype(float)
    weights = np.array([1.0, 1.0, 1.0, ARM**-2, ARM**-2, ARM**-2])
    error = np.einsum("nij,nj->ni", grasp, (forces * mask[..., None]).reshape(len(forces), -1)) - wrench
    deviation = (forces - reference) * mask[..., None]
    cost = 0.5 * (weights * error**2).sum(1) + 0.5 * REGULARIZATION * (deviation**2).sum((1, 2))
    gradient = np.einsum("nij,ni->nj", grasp, weights * error).reshape(forces.shape) + REGULARIZATION * deviation
    return cost, gradient * mask[..., None]


def above_optimum(gradient, forces, mask):
    """The most by which a convex cost can be above its minimum: over the corners of each contact's allowed forces."""
    mu = LIMITS.friction
    sides = np.array([[mu, 0, 1], [-mu, 0, 1], [0, mu, 1], [0, -mu, 1]])
    corners = np.concatenate([LIMITS.lowest * sides, LIMITS.highest * sides])
    least = (gradient @ corners.T).min(axis=2)
    return (((gradient * forces.numpy()).sum(2) - least) * mask.numpy()).sum(1)


def test_forces_are_allowed_and_optimal():
    """Inside pyramids and limits, exactly zero where nothing touches, and no allowed forces cost less.

    With the controller's precision and iterations, forces are worse than these by no more than 3 N.
    """
    problem = random_problems()
    mask = problem[3]
    forces, residual = ForceDistribution(LIMITS, ARM, REGULARIZATION, "cpu", torch.float64)(*problem, CONVERGED)
    assert (forces[~mask] == 0.0).all()
    tangential, normal = forces[mask][:, :2].abs().sum(1), forces[mask][:, 2]
    assert (tangential <= LIMITS.friction * normal).all()
    assert (normal >= LIMITS.lowest).all() and (normal <= LIMITS.highest).all()
    for at_limit in (
        tangential > 0.999 * LIMITS.friction * normal,
        normal < 1.001 * LIMITS.lowest,
        normal > 0.999 * LIMITS.highest,
    ):
        assert at_limit.sum() > 10  # every kind of limit matters in these problems
    cost, gradient = cost_and_gradient(problem, forces)
    assert (above_optimum(gradient, forces, mask) <= 1e-6 * cost + 1e-6).all()
    given = (problem[0] @ (forces * mask.unsqueeze(2)).flatten(1).unsqueeze(2)).squeeze(2)
    torch.testing.assert_close(residual, given - problem[1], rtol=0, atol=1e-9)
    single, _ = ForceDistribution(LIMITS, ARM, REGULARIZATION, "cpu")(*(part.float() for part in problem[:3]), mask)
    assert (cost_and_gradient(problem, single)[0] - cost <= 0.5 * 3.0**2).all()


@pytest.mark.parametrize("limits", [(0.0, 0.0, 100.0), (0.5, -1.0, 100.0), (0.5, 10.0, 10.0)])
def test_refuses_empty_limits(limits):
    """Limits that no force is inside of are refused."""
    with pytest.raises(UserError, match="friction > 0"):
        ForceDistribution(ForceLimits(*limits), ARM, REGULARIZATION, "cpu")
