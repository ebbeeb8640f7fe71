"""Telling that a training cannot learn, and why."""

from __future__ import annotations

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.learning.ppo import OnDevicePPO
from legged_torque.sim.health import Watched
from legged_torque.utils import distributed
from legged_torque.utils.display import warn
from legged_torque.utils.errors import TrainingError

PATIENCE = 5  # iterations in a row without learning
MAX_DIVERGED = 0.5  # share of the worlds that may diverge in an iteration


class TrainingGuard:
    """Follows a training from iteration to iteration; all processes that train together see the same.

    Attributes:
        problem: Why training cannot go on; empty while it can.
    """

    problem = ""

    def __init__(self, task: LeggedRobot, alg: OnDevicePPO) -> None:
        """Watch the training of a policy in a task."""
        self._task, self._alg = task, alg
        self._num_updates = alg.num_learning_epochs * alg.num_mini_batches
        self._without_update = self._diverging = 0  # iterations in a row
        self._told: set[Watched] = set()

    def add_iteration(self, skipped_updates: float) -> dict[str, float]:
        """Judge an iteration, tell what was not finite for the first time, and return its numbers to be logged."""
        share, found = self._task.health.read()
        for tensor, count in found.items():
            if tensor not in self._told and distributed.rank() == 0:
                warn(f"{tensor} was not finite; resets of worlds for it: {count}")
        self._told.update(found)
        self._without_update = self._without_update + 1 if skipped_updates >= self._num_updates else 0
        self._diverging = self._diverging + 1 if share > MAX_DIVERGED else 0
        reasons = []
        if self._without_update >= PATIENCE:
            rate = float(self._alg.learning_rate)
            reasons.append(
                f"all {self._num_updates} updates of each of the last {PATIENCE} iterations were skipped, since a "
                f"gradient, weight or moment would not have been finite (learning rate {rate:g})"
            )
        if self._diverging >= PATIENCE:
            reasons.append(f"more than half of the worlds diverged in each of {PATIENCE} iterations, now {share:.0%}")
        if reasons:
            names = ", ".join(f"{tensor} {count}" for tensor, count in found.items())
            self.problem = "; ".join([*reasons, *([f"not finite, with resets of worlds: {names}"] if names else [])])
        return {f"Health/not_finite/{tensor.tag}": float(count) for tensor, count in found.items()}

    def check(self) -> None:
        """Raise a TrainingError if training cannot go on."""
        if self.problem:
            raise TrainingError(f"training cannot learn: {self.problem}")
