"""How well a policy walks: the paper's five metrics (section IV-A), and what Figure 5 shows besides."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.legged_robot import LeggedRobot

COMMANDS = ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")
NUM_BINS = 4
"""Into how many equal parts the range of each command is split."""


@dataclass
class Estimate:
    """A mean over worlds and steps.

    Attributes:
        mean: The mean.
        standard_error: Its standard error, from the differences between worlds; NaN with one world.
    """

    mean: float
    standard_error: float


class WalkingMetrics:
    """Sums over the steps of a task, per world and kept on the device.

    Every metric is a ratio of two sums. Velocities are those of the trunk in its own frame. Steps after which a world
    was reset are left out, but for the count of falls.

    - track_percentage: mean of max(0, mean over the commands that are not 0 of 1 - |v - v*| / |v*|); 1 is perfect.
    - track_xy: mean of |v*_xy - v_xy|^2 [m^2/s^2]. track_angular: mean of (w*_z - w_z)^2 [rad^2/s^2].
    - collision_force: mean of the sum over geoms of the norm of the ground's force, in the last physics step of a
      control step [N]. A robot that stands still has its weight, 122 N for the A1, and a little more where its feet
      push sideways: 127 N in the nominal pose.
    - cost_of_transport: mean of sum |tau_i qd_i| over m g times mean horizontal speed, with the nominal m g.
    - height: mean height of the trunk's origin [m]. speed: mean horizontal speed [m/s].
    - falls_per_minute: resets that are not time-outs, per minute of one robot.
    """

    def __init__(self, task: LeggedRobot) -> None:
        """Start with empty sums."""
        self._task = task
        model = task.sim.mj_model
        self._weight = float(model.body_mass.sum()) * abs(float(model.opt.gravity[2]))
        self._sums = torch.zeros(10, task.num_envs, device=task.device)

    def clear(self) -> None:
        """Forget all steps."""
        self._sums.zero_()

    def add_step(self, commands: Tensor) -> None:
        """Add the step that the task has just made.

        Args:
            commands: A copy of the commands that held during the step. Shape: (num_envs, 3).
        """
        task = self._task
        velocity = torch.cat([task.base_lin_vel[:, :2], task.base_ang_vel[:, 2:]], dim=1)
        error = (commands - velocity).abs()
        percentage, is_commanded = tracking_percentage(error, commands)
        rows = torch.stack(
            [
                torch.ones_like(percentage),
                percentage,
                is_commanded,
                error[:, :2].square().sum(dim=1),
                error[:, 2].square(),
                task.sim.contact_force.norm(dim=2).sum(dim=1),
                (task.torques * task.dof_vel).abs().sum(dim=1),
                task.base_pos[:, 2],
                velocity[:, :2].norm(dim=1),
                torch.zeros_like(percentage),
            ]
        )
        rows = torch.where(task.reset_buf, 0.0, rows)
        rows[-1] = task.reset_buf & ~task.time_out_buf
        self._sums += rows

    def ratios(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Return numerator and denominator of each metric, per world. Shapes: (num_envs,)."""
        steps, percentage, commanded, xy, angular, force, power, height, speed, falls = self._sums
        return {
            "track_percentage": (percentage, commanded),
            "track_xy": (xy, steps),
            "track_angular": (angular, steps),
            "collision_force": (force, steps),
            "cost_of_transport": (power, self._weight * speed),
            "height": (height, steps),
            "speed": (speed, steps),
            "falls_per_minute": (falls, steps * (self._task.dt / 60.0)),
        }

    def means(self) -> dict[str, float]:
        """Return the metrics over all steps and worlds; NaN where nothing was measured. Waits once for the device."""
        ratios = self.ratios()
        means = torch.stack([numerator.sum() / denominator.sum() for numerator, denominator in ratios.values()])
        return dict(zip(ratios, means.tolist(), strict=True))

    def estimates(self) -> dict[str, Estimate]:
        """Return the metrics with standard errors."""
        return {name: estimate(*sums) for name, sums in self.ratios().items()}


class CommandBreakdown:
    """Tracking by commanded velocity: each command's range is split into :data:`NUM_BINS` equal parts."""

    def __init__(self, task: LeggedRobot) -> None:
        """Start with empty sums."""
        self._task = task
        ranges = task.cfg.commands.ranges
        self._ranges = torch.tensor([getattr(ranges, name) for name in COMMANDS], device=task.device)
        self._sums = torch.zeros(4, len(COMMANDS), NUM_BINS, device=task.device)

    def add_step(self, commands: Tensor) -> None:
        """Add the step that the task has just made; arguments as for :meth:`WalkingMetrics.add_step`."""
        task = self._task
        velocity = torch.cat([task.base_lin_vel[:, :2], task.base_ang_vel[:, 2:]], dim=1)
        error = (commands - velocity).abs()
        tracking = torch.stack(tracking_percentage(error, commands)).unsqueeze(2).expand(-1, *error.shape)
        low, high = self._ranges.T
        place = ((commands - low) / (high - low).clamp(min=1e-6) * NUM_BINS).long().clamp(0, NUM_BINS - 1)
        member = torch.nn.functional.one_hot(place, NUM_BINS) * ~task.reset_buf.view(-1, 1, 1)
        rows = torch.stack([torch.ones_like(error), error, *tracking])
        self._sums += (rows.unsqueeze(3) * member).sum(dim=1)

    def table(self) -> dict[str, list[dict[str, float]]]:
        """Return for each command its parts that occurred.

        Returns:
            Per part: "from" and "to" of the command, "share" of the steps, "track_percentage" (of all three commands,
            NaN if all were 0), and "error": mean |v - v*| of this command [m/s or rad/s].
        """
        result: dict[str, list[dict[str, float]]] = {}
        for i, name in enumerate(COMMANDS):
            low, high = self._ranges[i].tolist()
            count, error, percentage, commanded = self._sums[:, i].tolist()
            result[name] = [
                {
                    "from": low + (high - low) * part / NUM_BINS,
                    "to": low + (high - low) * (part + 1) / NUM_BINS,
                    "share": count[part] / sum(count),
                    "track_percentage": percentage[part] / commanded[part] if commanded[part] else math.nan,
                    "error": error[part] / count[part],
                }
                for part in range(NUM_BINS)
                if count[part]
            ]
        return result


def tracking_percentage(error: Tensor, commands: Tensor) -> tuple[Tensor, Tensor]:
    """Return how much of its commands each world follows, and 1 where anything was commanded, else 0.

    Args:
        error: |v - v*|. Shape: (num_envs, 3).
        commands: v*. Shape: (num_envs, 3). Those that are exactly 0 do not count.
    """
    counts = commands != 0.0
    relative = torch.where(counts, 1.0 - error / commands.abs(), 0.0)
    number = counts.sum(dim=1)
    return (relative.sum(dim=1) / number.clamp(min=1)).clamp(min=0.0), (number > 0).float()


def estimate(numerator: Tensor, denominator: Tensor) -> Estimate:
    """Return a ratio of sums over worlds with its standard error, which takes worlds as independent (delta method).

    Args:
        numerator: Shape: (num_envs,).
        denominator: Shape: (num_envs,).
    """
    numerator, denominator = numerator.double().cpu(), denominator.double().cpu()
    total, count = denominator.sum(), len(numerator)
    mean = numerator.sum() / total
    variance = (numerator - mean * denominator).square().sum() * count / max(count - 1, 1)
    return Estimate(float(mean), float(variance.sqrt() / total) if count > 1 else float("nan"))


def measure(
    task: LeggedRobot,
    policy: Callable[[TensorDict], Tensor],
    num_steps: int,
    on_step: Callable[[Tensor], None] = lambda commands: None,
) -> WalkingMetrics:
    """Let a policy act from fresh episodes on, and return its metrics.

    Args:
        task: Where it acts.
        policy: Actions for observations; give it mean actions to see what it has learned.
        num_steps: Control steps.
        on_step: Called after every step with the commands that held, e.g. to record it.
    """
    metrics = WalkingMetrics(task)
    obs = task.reset()
    with torch.inference_mode():
        for _ in range(num_steps):
            commands = task.commands.clone()
            obs = task.step(policy(obs))[0]
            metrics.add_step(commands)
            on_step(commands)
    return metrics
