"""A guard that ends trainings which cannot learn."""

from collections.abc import Mapping

from legged_torque.learning.protocols import Health
from legged_torque.sim.health import Watched
from legged_torque.utils import distributed
from legged_torque.utils.display import warn

PATIENCE = 5  # iterations in a row without learning
MAX_DIVERGED = 0.5  # share of the worlds that may diverge in an iteration


class TrainingGuard:
    """Follows a training from iteration to iteration; all processes that train together see the same numbers.

    Attributes:
        problem: Why training cannot go on; empty while it can.
    """

    problem = ""

    def __init__(self, health: Health) -> None:
        """Watch a training by the health of its task."""
        self._health = health
        self._without_update = self._diverging = 0  # iterations in a row
        self._reported: set[Watched] = set()

    def add_iteration(self, numbers: Mapping[str, float]) -> dict[str, float]:
        """Check an iteration, warn of tensors that became non-finite, and return their resets of worlds to be logged.

        ``numbers`` are those of the learner's update.
        """
        share, found = self._health.read()
        for tensor, count in found.items():
            if tensor not in self._reported and distributed.rank() == 0:
                warn(f"{tensor} was not finite; resets of worlds for it: {count}")
        self._reported.update(found)
        self._without_update = self._without_update + 1 if numbers.get("all_skipped") else 0
        self._diverging = self._diverging + 1 if share > MAX_DIVERGED else 0
        reasons = []
        if self._without_update >= PATIENCE:
            rate = f" (learning rate {numbers['learning_rate']:g})" if "learning_rate" in numbers else ""
            reasons.append(
                f"all {numbers['skipped_updates']:g} updates of each of the last {PATIENCE} iterations were skipped, "
                f"since a gradient, weight or moment would not have been finite{rate}"
            )
        if self._diverging >= PATIENCE:
            reasons.append(f"more than half of the worlds diverged in each of {PATIENCE} iterations, now {share:.0%}")
        if reasons and found:
            names = ", ".join(f"{tensor} {count}" for tensor, count in found.items())
            reasons.append(f"not finite, with resets of worlds: {names}")
        self.problem = "; ".join(reasons)
        return {f"Health/not_finite/{tensor.tag}": float(count) for tensor, count in found.items()}
