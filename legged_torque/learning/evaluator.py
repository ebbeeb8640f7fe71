"""Evaluation of a policy while it learns, in worlds of their own."""

import contextlib
import copy
import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils._pytree import tree_map

from legged_torque.learning.memory import acting
from legged_torque.learning.protocols import Evaluation
from legged_torque.learning.random_state import own_random_numbers, seeded_state
from legged_torque.sim.graph import MAX_CAPTURED_STEPS, CudaGraph
from legged_torque.utils.errors import UserError, check_names
from legged_torque.utils.files import append_whole
from legged_torque.utils.runs import tagged

SEED = 10_000  # added to the seed of a training, once for its first evaluator, twice for the second, and so on
WARM_UP_TIME = 2.0
"""Least simulated time before the first evaluation [s], in whole evaluations: all robots start from random states."""

Policy = Callable[[TensorDict], Tensor]
"""Observations to mean actions."""


class TrainingEvaluator:
    """Evaluates the policy of a training now and then, in worlds that are built for the first evaluation.

    Its worlds have random numbers of their own, and go on where the last evaluation left them. An evaluation has as
    many steps of robots as the paper's 16 worlds x 2000 steps, but in many worlds at once. Training is the same with
    and without it. Robots stuck under an early policy stay stuck until time-out, so early metrics lag. The evaluation
    at the end of a training, where none is due, leaves no trace in those of a training that goes on.

    Attributes:
        name: The environment, if it is one of ``evaluation.also``; empty for that of ``evaluation.perturbation``.
    """

    def __init__(
        self, task: Any, policy: Policy, settings: dict[str, Any], seed: int, name: str = "", capture: bool = False
    ) -> None:
        """Prepare; nothing is built yet.

        Args:
            task: The task of the training, with ``make_evaluation``; its counters give the curricula.
            policy: What is measured.
            settings: ``evaluation`` of the training's settings.
            seed: Of the random numbers.
            name: See above.
            capture: Whether evaluations replay as CUDA graphs on a GPU.
        """
        self.name = name
        self._task, self._policy, self._settings, self._seed = task, policy, settings, seed
        self._num_envs = min(settings["num_envs"], task.num_envs)
        self._num_steps = math.ceil(settings["num_samples"] / self._num_envs)
        run = functools.partial(self._run, self._num_steps)
        self._graph = CudaGraph(run, task.device, capture and self._num_steps <= MAX_CAPTURED_STEPS)
        self.reset()

    def reset(self) -> None:
        """Let the next evaluation be the first one."""
        self._evaluation: Evaluation | None = None
        self._random_state = seeded_state(self._task.device, self._seed)
        self._warm_up_runs = math.ceil(WARM_UP_TIME / self._task.dt / self._num_steps)
        self._graph.reset()

    def due(self, before: int, steps: int, is_last: bool = False) -> bool:
        """Return whether to evaluate after a rollout from ``before`` to ``steps`` of the training, maybe its last."""
        interval = self._settings["interval"]
        is_time = interval > 0 and ((is_last and self._settings["at_end"]) or steps // interval > before // interval)
        return is_time and (not self.name or steps >= self._settings["also_from"])

    def evaluate(self, most_steps: float = math.inf) -> tuple[dict[str, float], dict[str, float]]:
        """Return the metrics of the policy, and the levels of the training's ground, at this moment of training.

        Warm-up and evaluation take at most so many control steps, but at least one.
        """
        num_steps = int(min(self._num_steps, max(1, most_steps / 2)))
        run = self._graph if num_steps == self._num_steps else functools.partial(self._run, num_steps)
        evaluation = self._build()
        evaluation.task.total_steps.copy_(self._task.total_steps)
        evaluation.task.update_curriculum()
        with own_random_numbers(self._task.device, self._random_state), _in_evaluation(self._policy):
            for _ in range(int(min(self._warm_up_runs, max(0, most_steps / num_steps - 1)))):
                run()
            self._warm_up_runs = 0
            evaluation.clear()
            run()
        return evaluation.means(), evaluation.levels()

    def evaluate_at_end(self, most_steps: float) -> tuple[dict[str, float], dict[str, float]]:
        """Return the same as :meth:`evaluate`; the next evaluations are as without this one."""
        before = copy.deepcopy(self.state_dict())
        result = self.evaluate(most_steps)
        self.load_state_dict(before) if before else self.reset()
        return result

    def state_dict(self) -> dict[str, Any]:
        """Return the worlds and their random numbers, by the evaluator's name; nothing if they are not built."""
        if self._evaluation is None:
            return {}
        state = {"worlds": self._evaluation.task.world_state_dict(), "random_state": self._random_state}
        state["memory"] = getattr(self._acting, "memory", None)
        return {tagged("evaluation", self.name): state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a :meth:`state_dict`, which may have further entries; a UserError if it does not fit."""
        mine = state.get(tagged("evaluation", self.name))
        if mine:
            self._build().task.load_world_state_dict(mine["worlds"])
            if mine["memory"] is not None:
                self._acting.memory = tree_map(lambda value: value.to(self._task.device), mine["memory"])
            self._random_state.update(mine["random_state"])
            self._warm_up_runs = 0

    def _build(self) -> Evaluation:
        """Return the worlds, which are built at the first call."""
        if self._evaluation is None:
            with own_random_numbers(self._task.device, self._random_state):
                perturbation = self.name or self._settings["perturbation"]
                self._evaluation = self._task.make_evaluation(self._num_envs, perturbation)
                worlds = self._evaluation.task
            self._acting = acting(self._policy, lambda: worlds)
        return self._evaluation

    def _run(self, num_steps: int) -> None:
        """Let the policy act; runs as a CUDA graph."""
        evaluation = self._build()
        with torch.no_grad():
            obs = evaluation.task.get_observations()
            for _ in range(num_steps):
                obs = evaluation.step(self._acting(obs))


@contextlib.contextmanager
def _in_evaluation(policy: Any) -> Iterator[None]:
    """Set a policy that is in training to evaluation, as ``evaluate.py`` has it, and back."""
    is_training = getattr(policy, "training", False)
    if is_training:
        policy.eval()
    try:
        yield
    finally:
        if is_training:
            policy.train()


def make_evaluators(task: Any, policy: Policy, settings: dict, seed: int, capture: bool) -> list[TrainingEvaluator]:
    """Return the evaluators of a training, with its settings ``evaluation`` and its seed.

    A UserError if an environment is unknown, or the task cannot be evaluated, but shall be.
    """
    if settings["interval"] and not hasattr(task, "make_evaluation"):
        raise UserError(f"{type(task).__name__} has no make_evaluation() for evaluations; set evaluation.interval=0")
    for key, names in {"perturbation": [settings["perturbation"]], "also": settings["also"]}.items():
        for name in filter(None, names):
            check_names(f"evaluation.{key}", [name], task.cfg.perturbations())
    names = enumerate(dict.fromkeys(["", *settings["also"]]), 1)
    return [TrainingEvaluator(task, policy, settings, seed + SEED * i, name, capture) for i, name in names]


def append_row(file: Path, row: dict[str, float]) -> None:
    """Append a row to a CSV file, after a header if the file is new; a UserError if it cannot be written.

    A file of another version keeps its columns.
    """
    header = file.read_text("utf-8").partition("\n")[0] if file.is_file() else ""
    values = [row.get(name, math.nan) for name in header.split(",")] if header else row.values()
    cells = [f"{value:.6g}" if isinstance(value, float) else str(value) for value in values]
    lines = [cells] if header else [row, cells]
    append_whole(file, "".join(",".join(line) + "\n" for line in lines))
