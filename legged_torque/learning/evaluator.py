"""Evaluation of a policy while it learns, in worlds of their own."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.learning.protocols import Evaluation
from legged_torque.learning.worlds import load_world_state, world_state
from legged_torque.sim.graph import MAX_CAPTURED_STEPS, CudaGraph
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.files import told_by_name
from legged_torque.utils.random_state import own_random_numbers, seeded_state
from legged_torque.utils.runs import tagged

SEED = 10_000  # added to the seed of a training, once for its first evaluator, twice for the second, and so on
WARM_UP_TIME = 2.0
"""Least simulated time before the first evaluation [s], in whole evaluations: all robots start from random states."""

Policy = Callable[[TensorDict], Tensor]
"""Observations to mean actions."""


class TrainingEvaluator:
    """Evaluates the policy of a training now and then.

    Its worlds have random numbers of their own, and go on where the last evaluation left them. An evaluation has as
    many steps of robots as the paper's 16 worlds x 2000 steps, but in many worlds at once. Training is the same with
    and without it. Robots stuck under an early policy stay stuck until time-out, so early metrics lag.
    """

    def __init__(self, task: Any, policy: Policy, settings: dict[str, Any], seed: int, capture: bool = False) -> None:
        """Build the worlds; on a GPU with ``capture``, they replay as CUDA graphs.

        Args:
            task: The task of the training, with ``make_evaluation``; its counters give the curricula.
            policy: What is measured.
            settings: ``num_envs``, ``num_samples`` and ``perturbation`` of the training's ``evaluation``.
            seed: Of the random numbers.
            capture: See above.
        """
        self._task, self._policy = task, policy
        self._random_state = seeded_state(task.device, seed)
        with own_random_numbers(task.device, self._random_state):
            num_envs = min(settings["num_envs"], task.num_envs)
            self._evaluation: Evaluation = task.make_evaluation(num_envs, settings["perturbation"])
            self.worlds = worlds = self._evaluation.task
            worlds.episode_length_buf = torch.randint_like(worlds.episode_length_buf, int(worlds.max_episode_length))
        self._num_steps = math.ceil(settings["num_samples"] / num_envs)
        self._warm_up_runs = math.ceil(WARM_UP_TIME / worlds.dt / self._num_steps)
        self._graph = CudaGraph(self._run, task.device, capture and self._num_steps <= MAX_CAPTURED_STEPS)

    def evaluate(self) -> dict[str, float]:
        """Return the metrics of the policy at this moment of training."""
        self.worlds.total_steps.copy_(self._task.total_steps)
        self.worlds.update_curriculum()
        with own_random_numbers(self._task.device, self._random_state):
            for _ in range(self._warm_up_runs):
                self._graph()
            self._warm_up_runs = 0
            self._evaluation.clear()
            self._graph()
        return self._evaluation.means()

    def levels(self) -> dict[str, float]:
        """Return the levels of the training's ground at this moment."""
        return self._evaluation.levels()

    def state_dict(self) -> dict[str, Any]:
        """Return the worlds and their random numbers."""
        return {"worlds": world_state(self.worlds), "random_state": self._random_state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a :meth:`state_dict`; a UserError, and nothing changed, if it does not fit."""
        load_world_state(self.worlds, state["worlds"])
        self._random_state.update(state["random_state"])
        self._warm_up_runs = 0

    def _run(self) -> None:
        """Let the policy act; runs as a CUDA graph."""
        with torch.no_grad():
            obs = self.worlds.get_observations()
            for _ in range(self._num_steps):
                obs = self._evaluation.step(self._policy(obs))


class TrainingEvaluators:
    """The evaluators of a training, each built when it is first needed.

    Their names are the environments of ``evaluation.also``; "" is that of ``evaluation.perturbation``.
    """

    def __init__(self, task: Any, policy: Policy, settings: dict[str, Any], seed: int, capture: bool) -> None:
        """Take the arguments of :class:`TrainingEvaluator`, with the settings ``evaluation`` and the training's seed.

        A UserError if an environment is unknown, or the task cannot be evaluated, but shall be.
        """
        self._task, self._policy, self._settings, self._seed, self._capture = task, policy, settings, seed, capture
        self._names = list(dict.fromkeys(["", *settings["also"]]))
        self._built: dict[str, TrainingEvaluator] = {}
        if settings["interval"] and not hasattr(task, "make_evaluation"):
            name = type(task).__name__
            raise UserError(f"{name} has no make_evaluation() for evaluations; set evaluation.interval=0")
        for key in ("perturbation", "also"):
            for name in filter(None, [settings[key]] if key == "perturbation" else settings[key]):
                if name not in task.cfg.perturbations():
                    raise unknown_name(f"evaluation.{key}", name, task.cfg.perturbations())

    def due(self, before: int, steps: int) -> list[str]:
        """Return the names of the evaluators to run after a rollout from ``before`` to ``steps``."""
        interval = self._settings["interval"]
        if interval == 0 or steps // interval == before // interval:
            return []
        return [name for name in self._names if not name or steps >= self._settings["also_from"]]

    def get(self, name: str) -> TrainingEvaluator:
        """Return an evaluator."""
        if name not in self._built:
            settings = self._settings | ({"perturbation": name} if name else {})
            seed = self._seed + SEED * (1 + self._names.index(name))
            self._built[name] = TrainingEvaluator(self._task, self._policy, settings, seed, self._capture)
        return self._built[name]

    def state_dict(self) -> dict[str, Any]:
        """Return the states of all that are built, with keys "evaluation" and "evaluation_<name>"."""
        return {tagged("evaluation", name): evaluator.state_dict() for name, evaluator in self._built.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a :meth:`state_dict`, which may have further entries; a UserError if it does not fit."""
        for name in self._names:
            if tagged("evaluation", name) in state:
                self.get(name).load_state_dict(state[tagged("evaluation", name)])

    def clear(self) -> None:
        """Let all start anew."""
        self._built.clear()


def append_row(file: Path, row: dict[str, float]) -> None:
    """Append a row to a CSV file, after a header if the file is new; a UserError if it cannot be written."""
    is_new = not file.exists()
    with told_by_name(file), file.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, row, lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()})
