"""Worlds in which a policy is measured, with the settings for that."""

import copy
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.metrics import WalkingMetrics
from legged_torque.utils.config import section_keys
from legged_torque.utils.options import apply_perturbation


class WalkingEvaluation:
    """A copy of a task, without rewards, in which the steps of a policy are measured while it trains.

    Attributes:
        task: The worlds, a :class:`~legged_torque.envs.base.legged_robot.LeggedRobot`.
    """

    def __init__(self, source: Any, num_envs: int, perturbation: str) -> None:
        """Build the worlds of a copy of the training's task ``source``, in an environment as in `evaluation_cfg`."""
        self._source = source
        self.task = type(source)(evaluation_cfg(source.cfg, num_envs, perturbation), source.device)
        self.task.step_graph.enabled = source.step_graph.enabled
        self._metrics = WalkingMetrics(self.task)
        before = self._steps_before = self.task.keep("steps_before", self.task.steps_before)
        before.copy_(torch.randint_like(before, self.task.max_episode_length))

    def step(self, actions: Tensor) -> TensorDict:
        """Make a control step, measure it, and return the observations; a fall does not put off a time-out."""
        task, commands, before = self.task, self.task.state.commands.clone(), self._steps_before
        clock = (before + task.episode_length_buf + 1) % task.max_episode_length
        obs = task.step(actions)[0]
        before.copy_(clock - task.episode_length_buf)  # or worlds whose robots fall together would time out together
        self._metrics.add_step(commands)
        return obs

    def clear(self) -> None:
        """Forget the steps so far."""
        self._metrics.clear()

    def means(self) -> dict[str, float]:
        """Return the metrics of the steps so far, see :class:`WalkingMetrics`."""
        return self._metrics.means()

    def levels(self) -> dict[str, float]:
        """Return the mean level of the training's ground, if it has levels."""
        return {name: float(level) for name, level in self._source.terrain.curriculum_values().items()}


def evaluation_cfg(cfg: Any, num_envs: int, perturbation: str = "") -> Any:
    """Return a copy of a task's settings for evaluation in an environment; an empty name leaves that as it is.

    Levels of rough ground stay as they are, spread over all; commands are those of the full ranges.
    """
    cfg = copy.deepcopy(cfg)
    cfg.env.num_envs = num_envs
    cfg.terrain.curriculum = cfg.commands.curriculum = False
    for term in section_keys(cfg.rewards.scales):
        setattr(cfg.rewards.scales, term, 0.0)
    if perturbation:
        apply_perturbation(cfg, perturbation)
    return cfg
