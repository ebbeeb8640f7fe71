"""Metrics of a walking policy, in all and by command."""

from collections.abc import Callable
from typing import Any, Protocol

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.state import RobotState
from legged_torque.envs.base.step_meter import StepMeter
from legged_torque.sim.engine import Engine
from legged_torque.utils import metrics
from legged_torque.utils.display import Counter

COMMANDS = ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")
NUM_BINS = 4  # into how many equal parts the range of each command is split


class WalkingTask(Protocol):
    """What is measured of a task; see :class:`~legged_torque.envs.base.legged_robot.LeggedRobot`."""

    cfg: Any
    sim: Engine
    state: RobotState
    meter: StepMeter
    num_envs: int
    device: str
    dt: float

    def measure_steps(self) -> None:
        """Let ``meter`` measure all steps from now on."""

    def reset(self) -> TensorDict:
        """Start a new episode in every world, and return the observations."""

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Make a control step, and return the observations first."""


class WalkingMetrics:
    """Sums of :mod:`legged_torque.utils.metrics` over the steps of a task, per world and kept on the device."""

    def __init__(self, task: WalkingTask) -> None:
        """Start with empty sums."""
        self._task = task
        task.measure_steps()
        model = task.sim.mj_model
        self.weight = float(model.body_mass.sum()) * abs(float(model.opt.gravity[2]))
        self._sums = torch.zeros(metrics.NUM_SUMS, task.num_envs, device=task.device)

    def clear(self) -> None:
        """Forget all steps."""
        self._sums.zero_()

    def add_step(self, commands: Tensor, counted: Tensor | None = None) -> None:
        """Add the step that the task has just made, with a copy of the commands that held in it (num_envs, 3).

        Only in the worlds that are ``counted``, if it is given. Shape: (num_envs,), bool.
        """
        state, meter = self._task.state, self._task.meter
        velocity = state.planar_velocity()
        sums = metrics.step_sums(
            torch,
            commands,
            velocity,
            speed=velocity[:, :2].norm(dim=1),
            force=state.contact_force.norm(dim=2).sum(dim=1),
            power=meter.mechanical,
            copper=meter.copper,
            torque_change=meter.torque_change,
            height=state.base_height,
            fell=state.reset_buf & ~state.time_out_buf,
            ended=state.reset_buf,
            peak_force=meter.peak_force,
            tracked=num_tracked(self._task),
        )
        self._sums += sums if counted is None else sums * counted

    def ratios(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Return numerator and denominator of each metric, per world. Shapes: (num_envs,)."""
        return self._ratios(self._sums)

    def means(self) -> dict[str, float]:
        """Return the metrics over all steps and worlds; NaN where nothing was measured. Waits once for the device."""
        ratios = self.ratios()
        means = torch.stack([numerator.sum() / denominator.sum() for numerator, denominator in ratios.values()])
        return dict(zip(ratios, means.tolist(), strict=True))

    def estimates(self) -> dict[str, metrics.Estimate]:
        """Return the metrics with standard errors."""
        return metrics.estimates(self._ratios(self._sums.double().cpu().numpy()))

    def _ratios(self, sums: Any) -> dict[str, tuple[Any, Any]]:
        """Return the ratios of sums, which are a tensor or an array."""
        return metrics.ratios(sums, self.weight, self._task.dt, self._task.meter.has_losses)


class CommandBreakdown:
    """Tracking by commanded velocity: each command's range is split into :data:`NUM_BINS` equal parts."""

    def __init__(self, task: WalkingTask) -> None:
        """Start with empty sums."""
        self._task = task
        self._ranges = torch.tensor([task.cfg.commands.allowed()[name] for name in COMMANDS], device=task.device)
        shape = (task.num_envs, len(COMMANDS), NUM_BINS + 1)  # the last: commands of 0 outside of the range
        self._sums = torch.zeros(4, *shape, device=task.device)

    def add_step(self, commands: Tensor) -> None:
        """Add the step that the task has just made; arguments as for :meth:`WalkingMetrics.add_step`."""
        task = self._task
        error = (commands - task.state.planar_velocity()).abs()
        tracked = num_tracked(task)
        tracking = torch.stack(metrics.tracking_percentage(torch, error[:, :tracked], commands[:, :tracked]))
        low, high = self._ranges.T
        place = ((commands - low) / (high - low).clamp(min=1e-6) * NUM_BINS).long().clamp(0, NUM_BINS - 1)
        stands = (commands == 0.0) & ((low > 0.0) | (high < 0.0))
        place = place.masked_fill(stands, NUM_BINS)
        member = torch.nn.functional.one_hot(place, NUM_BINS + 1) * ~task.state.reset_buf.view(-1, 1, 1)
        rows = torch.stack([torch.ones_like(error), error, *tracking.unsqueeze(2).expand(-1, *error.shape)])
        self._sums += rows.unsqueeze(3) * member

    def table(self) -> dict[str, list[dict[str, float]]]:
        """Return for each command its parts that occurred.

        Returns:
            Per part: "from" and "to" of the command, "share" of the steps, "track_percentage" (of all that are tracked,
            NaN if all were 0), and "error": mean |v - v*| of this command [m/s or rad/s]; both have their standard
            errors under the names with "_standard_error".
        """
        result: dict[str, list[dict[str, float]]] = {}
        sums = self._sums.double().cpu().numpy()
        for i, name in enumerate(COMMANDS):
            low, high = self._ranges[i].tolist()
            result[name] = []
            for part in range(NUM_BINS):
                count, error, percentage, commanded = sums[:, :, i, part]
                if not count.any():
                    continue
                entry = {
                    "from": low + (high - low) * part / NUM_BINS,
                    "to": low + (high - low) * (part + 1) / NUM_BINS,
                    "share": count.sum() / sums[0, :, i].sum(),
                }
                for key, ratio in {"track_percentage": (percentage, commanded), "error": (error, count)}.items():
                    estimate = metrics.estimate(*ratio)
                    entry |= {key: estimate.mean, f"{key}_standard_error": estimate.standard_error}
                result[name].append(entry)
        return result


def num_tracked(task: WalkingTask) -> int:
    """Return how many of a task's commands count for the tracking percentage, the yaw rate being the last."""
    return 2 if task.cfg.commands.has_headings() else 3


def measure(
    task: WalkingTask,
    policy: Callable[[TensorDict], Tensor],
    num_steps: int,
    on_step: Callable[[Tensor], None] = lambda commands: None,
) -> WalkingMetrics:
    """Let a policy act from fresh episodes on, and return its metrics.

    Give it mean actions to see what it has learned. ``on_step`` is called after every step with the commands that held,
    e.g. to record it.
    """
    walking = WalkingMetrics(task)
    obs = task.reset()
    with torch.inference_mode(), Counter("evaluating, step", num_steps) as counter:
        for _ in range(num_steps):
            commands = task.state.commands.clone()
            obs = task.step(policy(obs))[0]
            walking.add_step(commands)
            on_step(commands)
            counter.add()
    return walking
