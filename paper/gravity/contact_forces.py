"""Contact forces inside friction cones and limits that give the trunk a wanted wrench, for many states at once.

Batched solvers exist, but none fits: qpth and qpax stop when the worst problem of the batch has converged, which waits
for the host at every iteration (and qpax needs JAX); ProxSuite's batches run on the CPU; cuML's nnls takes one matrix
for all problems and has no upper limits. The problems here are small and alike, so a primal-dual interior point method
of a fixed number of iterations does, on torch.linalg's batched Cholesky factorization.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from legged_torque.utils.errors import UserError

ITERATIONS = 12
"""Enough for single precision, with forces at most 3 N off; in double precision, each more gains about a digit."""
CENTERING = 0.1  # factor by which each iteration should reduce the complementarity
TO_BOUNDARY = 0.99  # share of the way to the nearest limit that a step may go


@dataclass(frozen=True)
class ForceLimits:
    """Forces that a contact can bear, on level ground."""

    friction: float  # mu of the pyramid |f_x| + |f_y| <= mu f_z, which lies inside the cone
    lowest: float  # normal force [N], at least 0
    highest: float  # normal force [N]


class ForceDistribution:
    """Finds contact forces that the contacts can bear and that come nearest to a wanted wrench on the trunk."""

    def __init__(
        self, limits: ForceLimits, arm: float, regularization: float, device: str, dtype: torch.dtype = torch.float32
    ) -> None:
        """Keep the settings and the constants on the device; a UserError if no force is inside the limits.

        ``arm`` [m] makes moments comparable with forces. ``regularization``, small against 1, weighs single forces
        against the wrench.
        """
        if limits.friction <= 0.0 or not 0.0 <= limits.lowest < limits.highest:
            raise UserError(f"contact forces need friction > 0 and 0 <= lowest < highest, not {limits}")
        mu, lowest = limits.friction, limits.lowest / limits.highest
        rows = [[x, y, -mu] for x in (1.0, -1.0) for y in (1.0, -1.0)] + [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
        self._rows = torch.tensor(rows, dtype=dtype, device=device)
        self._outer = (self._rows.unsqueeze(2) * self._rows.unsqueeze(1)).flatten(1)
        self._bounds = torch.tensor([0.0] * 4 + [1.0, -lowest], dtype=dtype, device=device)
        self._start = torch.tensor([0.0, 0.0, 0.5 * (1.0 + lowest)], dtype=dtype, device=device)
        self._weights = torch.tensor([1.0] * 3 + [1.0 / arm**2] * 3, dtype=dtype, device=device).unsqueeze(1)
        self._highest, self._regularization = limits.highest, regularization

    def __call__(
        self, grasp: Tensor, wrench: Tensor, reference: Tensor, mask: Tensor, iterations: int = ITERATIONS
    ) -> tuple[Tensor, Tensor]:
        """Return the contact forces f_csd (eq. 10), and the error of the wrench on the trunk.

        With G the grasp matrix and W weighing moments against forces, f_csd minimizes

            |W (G f - wrench)|^2 + regularization |f - reference|^2

        inside the friction pyramids and limits. As in eq. 10, forces stay as they are if they give the wrench within
        all limits; otherwise they change such that the wrench on the trunk changes as little as possible.

        Args:
            grasp: G, the first six rows of J_c^T. Shape: (n, 6, 3 k).
            wrench: Wanted force [N] and moment [N m] on the trunk. Shape: (n, 6).
            reference: Forces on the robot, in the world [N], to follow where the wrench allows. Shape: (n, k, 3).
            mask: Contacts that touch the ground. Shape: (n, k), bool.
            iterations: Iterations of the solver.

        Returns:
            Forces [N], exactly zero where nothing touches (n, k, 3); the residual G f - wrench [N, N m] (n, 6).
        """
        active = mask.unsqueeze(2)
        reference = torch.where(active, reference, 0.0).flatten(1).unsqueeze(2) / self._highest
        wrench = wrench.unsqueeze(2) / self._highest
        grasp = torch.where(mask.repeat_interleave(3, dim=1).unsqueeze(1), grasp, 0.0)
        weighted = (self._weights * grasp).mT
        hessian = weighted @ grasp
        hessian.diagonal(dim1=1, dim2=2).add_(self._regularization)
        forces = self._solve(hessian, weighted @ wrench + self._regularization * reference, active, iterations)
        residual = grasp @ forces.flatten(1).unsqueeze(2) - wrench
        return self._highest * forces, self._highest * residual.squeeze(2)

    def _solve(self, hessian: Tensor, linear: Tensor, active: Tensor, iterations: int) -> Tensor:
        """Minimize 1/2 f^T H f - b^T f within the limits, all in units of the highest normal force. Shape: (n, k, 3).

        Every iterate is inside the limits: the start is, and steps stop before them. Shapes of H, b and the mask of
        contacts: (n, 3 k, 3 k), (n, 3 k, 1), (n, k, 1).
        """
        forces = torch.where(active, self._start, 0.0)
        multipliers = active.to(forces).expand(*forces.shape[:2], len(self._bounds))
        limits_in_force = (multipliers.sum(dim=(1, 2), keepdim=True)).clamp(min=1.0)
        floor = 100.0 * torch.finfo(forces.dtype).eps  # below it, rounding decides which limits are reached
        for _ in range(iterations):
            slack = torch.where(active, self._bounds - forces @ self._rows.T, 1.0).clamp(min=0.01 * floor)
            gap = (slack * multipliers).sum(dim=(1, 2), keepdim=True) / limits_in_force
            target = torch.where(active, (CENTERING * gap).clamp(min=floor), 0.0)
            stiffness = multipliers / slack
            gradient = (hessian @ forces.flatten(1).unsqueeze(2) - linear).view_as(forces)
            step = self._newton_step(hessian, stiffness, gradient + (target / slack) @ self._rows)
            slack_step = -step @ self._rows.T
            multiplier_step = target / slack - multipliers - stiffness * slack_step
            nearest = torch.minimum(_room(slack, slack_step), _room(multipliers, multiplier_step))
            length = (TO_BOUNDARY * nearest).clamp(max=1.0).view(-1, 1, 1)
            forces = forces + length * step
            multipliers = multipliers + length * multiplier_step
        return forces

    def _newton_step(self, hessian: Tensor, stiffness: Tensor, gradient: Tensor) -> Tensor:
        """Solve (H + E^T D E) step = -gradient, E being the rows of all limits. Shapes of step, gradient: (n, k, 3)."""
        n, k, _ = stiffness.shape
        matrix = hessian.clone()
        blocks = matrix.view(n, k, 3, k, 3).diagonal(dim1=1, dim2=3)
        blocks.add_((stiffness @ self._outer).view(n, k, 3, 3).permute(0, 2, 3, 1))
        rounding = 4.0 * torch.finfo(matrix.dtype).eps  # must not make it singular
        matrix.diagonal(dim1=1, dim2=2).mul_(1.0 + rounding)
        factor = torch.linalg.cholesky_ex(matrix).L
        # A CUDA graph can capture triangular solves, but not cholesky_solve.
        half = torch.linalg.solve_triangular(factor, gradient.reshape(n, 3 * k, 1), upper=False)
        return -torch.linalg.solve_triangular(factor.mT, half, upper=True).view(n, k, 3)


def _room(values: Tensor, steps: Tensor) -> Tensor:
    """Return the share of its step after which the first value of each state is zero. Shape: (n,)."""
    return torch.where(steps < 0.0, -values / steps, math.inf).amin(dim=(1, 2))
