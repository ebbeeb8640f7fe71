"""Where the time of an iteration goes."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import torch

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.learning.runner import OnPolicyRunner
from legged_torque.sim.graph import CudaGraph


def time_parts(runner: OnPolicyRunner, rounds: int) -> dict[str, float]:
    """Time the parts of an iteration in one process, in turns, and return the median of each.

    Args:
        runner: The runner, with its task.
        rounds: How often each part is timed.

    Returns:
        Milliseconds of "physics" (the physics steps of one control step alone), "step" (``env.step``), "rollout",
        "update" and "iteration".
    """
    task = runner.env
    actions = 0.5 * torch.randn(task.num_envs, task.num_actions, device=task.device)

    def physics() -> None:
        decimation = task.cfg.control.decimation
        for i in range(decimation):
            task.sim.step(sense=i == decimation - 1)

    def iteration() -> None:
        runner.collect_rollout()
        runner.alg.update()

    physics_graph = CudaGraph(physics, task.device)
    repeats = 20 if torch.device(task.device).type == "cuda" else 1
    parts: dict[str, tuple[Callable[[], object], int]] = {
        "step": (lambda: task.step(actions), repeats),
        "physics": (physics_graph, repeats),
        "rollout": (runner.collect_rollout, 1),
        "update": (runner.alg.update, 1),
        "iteration": (iteration, 1),
    }
    times: dict[str, list[float]] = {name: [] for name in parts}
    for _ in range(rounds + 3):  # the first ones compile and capture
        for name, (function, count) in parts.items():
            times[name].append(_milliseconds(function, count, task))
    return {name: median(values[3:]) for name, values in times.items()}


def summarize(times: dict[str, float], num_envs: int, num_steps: int) -> dict[str, float]:
    """Return the times with what follows from them: steps per second, and ratios to physics alone."""
    samples = num_envs * num_steps
    return {
        "num_envs": num_envs,
        **{f"{name}_ms": value for name, value in times.items()},
        "step_over_physics": times["step"] / times["physics"],
        "iteration_over_physics": times["iteration"] / (times["physics"] * num_steps),
        "physics_steps_per_s": 1e3 * num_envs / times["physics"],
        "step_steps_per_s": 1e3 * num_envs / times["step"],
        "rollout_steps_per_s": 1e3 * samples / times["rollout"],
        "iteration_steps_per_s": 1e3 * samples / times["iteration"],
    }


def _milliseconds(function: Callable[[], object], count: int, task: LeggedRobot) -> float:
    """Return the mean time of one call of a function that is called ``count`` times."""
    _wait(task)
    start = time.perf_counter()
    for _ in range(count):
        function()
    _wait(task)
    return 1e3 * (time.perf_counter() - start) / count


def _wait(task: LeggedRobot) -> None:
    """Wait for the device."""
    if torch.device(task.device).type == "cuda":
        torch.cuda.synchronize(task.device)
