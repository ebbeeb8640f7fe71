"""How well a policy walks: the paper's tracking metrics and cost of transport (section IV-A), and falls."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.legged_robot import LeggedRobot


class WalkingMetrics:
    """Sums over the steps of a task, kept on the device."""

    def __init__(self, task: LeggedRobot) -> None:
        """Start with empty sums."""
        self._task = task
        model = task.sim.mj_model
        self._weight = float(model.body_mass.sum()) * abs(float(model.opt.gravity[2]))
        self._sums = torch.zeros(7, device=task.device)

    def add_step(self, commands: Tensor) -> None:
        """Add the step that the task has just made. Worlds that it has reset meanwhile are left out.

        Args:
            commands: A copy of the commands that held during the step. Shape: (num_envs, 3).
        """
        task = self._task
        velocity = torch.cat([task.base_lin_vel[:, :2], task.base_ang_vel[:, 2:]], dim=1)
        error = (commands - velocity).abs()
        rows = torch.stack(
            [
                torch.ones_like(error[:, 0]),
                error[:, :2].square().sum(dim=1),
                error[:, 2].square(),
                (1.0 - error / commands.abs()).mean(dim=1).clamp(min=0.0),
                (task.torques * task.dof_vel).abs().sum(dim=1),
                velocity[:, :2].norm(dim=1),
            ]
        )
        kept = torch.where(task.reset_buf, 0.0, rows).sum(dim=1)
        falls = (task.reset_buf & ~task.time_out_buf).sum().float()
        self._sums += torch.cat([kept, falls.unsqueeze(0)])

    def result(self) -> dict[str, float]:
        """Return the metrics over all steps and worlds.

        Returns:
            "track_percentage": mean of max(0, mean over the three command axes of 1 - |v - v*| / |v*|).
            "track_xy": mean of |v*_xy - v_xy|^2 [m^2/s^2]. "track_angular": mean of (w*_z - w_z)^2 [rad^2/s^2].
            "cost_of_transport": mean power sum |tau_i qd_i| over weight times mean horizontal speed.
            "speed": mean horizontal speed [m/s]. "falls_per_minute": of one robot.
        """
        samples, xy, angular, percentage, power, speed, falls = self._sums.tolist()
        samples = max(samples, 1.0)
        return {
            "track_percentage": percentage / samples,
            "track_xy": xy / samples,
            "track_angular": angular / samples,
            "cost_of_transport": power / max(self._weight * speed, 1e-9),
            "speed": speed / samples,
            "falls_per_minute": falls / (samples * self._task.dt / 60.0),
        }


def measure(
    task: LeggedRobot,
    policy: Callable[[TensorDict], Tensor],
    num_steps: int,
    on_step: Callable[[], None] = lambda: None,
) -> dict[str, float]:
    """Let a policy act from fresh episodes on, and return its :class:`WalkingMetrics`.

    Args:
        task: Where it acts.
        policy: Actions for observations; give it mean actions to see what it has learned.
        num_steps: Control steps.
        on_step: Called after every step, e.g. to record it.
    """
    metrics = WalkingMetrics(task)
    obs = task.reset()
    with torch.inference_mode():
        for _ in range(num_steps):
            commands = task.commands.clone()
            obs = task.step(policy(obs))[0]
            metrics.add_step(commands)
            on_step()
    return metrics.result()
