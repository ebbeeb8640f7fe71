"""Measuring a policy while it learns, in worlds of its own."""

from __future__ import annotations

import copy
import csv
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.metrics import WalkingMetrics
from legged_torque.learning.random_state import own_random_numbers, seeded_state
from legged_torque.learning.worlds import pack, unpack, world_tensors
from legged_torque.sim.graph import MAX_CAPTURED_STEPS, CudaGraph
from legged_torque.utils.config import section_keys
from legged_torque.utils.errors import unknown_name
from legged_torque.utils.files import write_errors
from legged_torque.utils.options import apply_perturbation
from legged_torque.utils.runs import tagged

SEED = 10_000  # added to the seed of a training, once for its first evaluator, twice for the second, and so on
SETTLING_TIME = 2.0
"""Least simulated time before the first evaluation [s], in whole evaluations: all robots start from random states."""


Policy = Callable[[TensorDict], Tensor]
"""Observations to actions."""


class TrainingEvaluator:
    """Evaluates the policy of a training now and then.

    Its worlds have their own random numbers, no rewards, and go on where the last evaluation left them: an evaluation
    has as many steps of robots as the paper's 16 worlds x 2000 steps, but in many worlds at once. Training is the same
    with and without it. Robots stuck under an early policy stay stuck until time-out, so early metrics lag.
    """

    def __init__(self, task: LeggedRobot, policy: Policy, settings: dict, seed: int) -> None:
        """Build the worlds; ``settings`` are ``evaluation`` of those of the training, the seed is its own.

        Curricula follow from the counters of ``task``, the one of the training. ``policy`` returns mean actions.
        """
        self._task, self._policy = task, policy
        cfg = evaluation_cfg(task.cfg, min(settings["num_envs"], task.num_envs), settings["perturbation"])
        self._random_state = seeded_state(task.device, seed)
        with own_random_numbers(task.device, self._random_state):
            self._env = type(task)(cfg, task.device)
            length = self._env.episode_length_buf
            self._env.episode_length_buf = torch.randint_like(length, int(self._env.max_episode_length))
        self._metrics = WalkingMetrics(self._env)
        self._num_steps = math.ceil(settings["num_samples"] / self._env.num_envs)
        enabled = task.step_graph.enabled
        self._env.step_graph.enabled = enabled
        self._settling_runs = math.ceil(SETTLING_TIME / self._env.dt / self._num_steps)
        self._graph = CudaGraph(self._run, task.device, enabled and self._num_steps <= MAX_CAPTURED_STEPS)

    def evaluate(self) -> dict[str, float]:
        """Return the metrics of :class:`WalkingMetrics` at this moment of training."""
        self._env.total_steps.copy_(self._task.total_steps)
        self._env.update_curriculum()
        with own_random_numbers(self._task.device, self._random_state):
            for _ in range(self._settling_runs):
                self._graph()
            self._settling_runs = 0
            self._metrics.clear()
            self._graph()
        return self._metrics.means()

    def state(self) -> dict[str, Any]:
        """Return what a file of tensors must hold for evaluations to go on: the worlds and their random numbers."""
        worlds = pack(world_tensors(self._env), self._env.num_envs)
        return {"worlds": worlds, "random_state": self._random_state}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from a :meth:`state`; a UserError, and nothing changed, if it does not fit."""
        unpack(state["worlds"], world_tensors(self._env), self._env.num_envs)
        self._random_state.update(state["random_state"])
        self._settling_runs = 0

    def _run(self) -> None:
        """Let the policy act; runs as a CUDA graph."""
        with torch.no_grad():
            obs = self._env.get_observations()
            for _ in range(self._num_steps):
                commands = self._env.commands.clone()
                obs = self._env.step(self._policy(obs))[0]
                self._metrics.add_step(commands)


class TrainingEvaluators:
    """The evaluators of a training, each built when it is first asked for.

    Their names are those of the environments of ``evaluation.also``; "" is the one of ``evaluation.perturbation``.
    """

    def __init__(self, task: LeggedRobot, policy: Policy, settings: dict, seed: int) -> None:
        """Take what :class:`TrainingEvaluator` does, with the training's seed; a UserError if a name is not known."""
        self._task, self._policy, self._settings, self._seed = task, policy, settings, seed
        self._names = list(dict.fromkeys(["", *settings["also"]]))
        self._built: dict[str, TrainingEvaluator] = {}
        known = task.cfg.perturbations()
        if settings["perturbation"] not in ("", *known):
            raise unknown_name("evaluation.perturbation", settings["perturbation"], known)
        for name in settings["also"]:
            if name not in known:
                raise unknown_name("evaluation.also", name, known)

    def due(self, before: int, steps: int) -> list[str]:
        """Return the names of those that shall measure, after a rollout from ``before`` to ``steps``."""
        interval = self._settings["interval"]
        if interval == 0 or steps // interval == before // interval:
            return []
        return [name for name in self._names if not name or steps >= self._settings["also_from"]]

    def get(self, name: str) -> TrainingEvaluator:
        """Return an evaluator."""
        if name not in self._built:
            settings = self._settings | ({"perturbation": name} if name else {})
            seed = self._seed + SEED * (1 + self._names.index(name))
            self._built[name] = TrainingEvaluator(self._task, self._policy, settings, seed)
        return self._built[name]

    def state(self) -> dict[str, Any]:
        """Return the states of all that are built, with keys "evaluation" and "evaluation_<name>"."""
        return {tagged("evaluation", name): evaluator.state() for name, evaluator in self._built.items()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from a :meth:`state`, which may hold other entries; a UserError if it does not fit."""
        for name in self._names:
            if state.get(tagged("evaluation", name)):
                self.get(name).load_state(state[tagged("evaluation", name)])

    def clear(self) -> None:
        """Let all start anew."""
        self._built.clear()


def evaluation_cfg(cfg: Any, num_envs: int, perturbation: str = "") -> Any:
    """Return a copy of a task's settings for evaluation in an environment; an empty name leaves that as it is.

    Levels of rough ground stay as they are, spread over all.
    """
    cfg = copy.deepcopy(cfg)
    cfg.env.num_envs = num_envs
    cfg.terrain.curriculum = False
    for term in section_keys(cfg.rewards.scales):
        setattr(cfg.rewards.scales, term, 0.0)
    if perturbation:
        apply_perturbation(cfg, perturbation)
    return cfg


def append_row(file: Path, row: dict[str, float]) -> None:
    """Append a row to a CSV file, after a header if the file is new; a UserError if it cannot be written."""
    is_new = not file.exists()
    with write_errors(file), file.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, row, lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()})
