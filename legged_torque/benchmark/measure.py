"""Speed and memory of training."""

import contextlib
import gc
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from statistics import median
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import warp as wp

from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.learning.runner import OnPolicyRunner
from legged_torque.sim.graph import CudaGraph, prepare_device
from legged_torque.utils.progress import CompileProgress
from legged_torque.utils.task_registry import set_seed

WARM_UP = 2  # iterations before timing begins: the first one compiles, the second one captures the rollout
PHYSICS_STEPS = 5
"""Control steps of physics timed in a row: enough to hide the cost of the reset before them, and no robot falls yet."""
ACTION_SCALE = 0.5  # standard deviation of the random actions while env.step is timed
GPU_CALLS = 20  # calls per timing on a GPU, where a single one is short; on the CPU one call is timed
_MIB = 2**20
_MS = 1e3

Times = dict[str, list[float]]
"""Milliseconds of iterations in a row, one entry each. "rollout": curriculum, and the rollout with its returns.
"update": the update of the networks. "log": reading numbers of the task, printing and writing them, and saving
checkpoints that are due. "iteration": their sum, from the start of one iteration to the start of the next."""


class MemoryMeter:
    """Memory used by this process.

    On a GPU: how much the free memory of the device has shrunk since the meter was created, by torch, Warp and loaded
    kernels. This includes other processes that allocate meanwhile, so measure on a GPU of your own. Allocators keep
    what they have taken, so the largest value between iterations is what training needs.

    On the CPU: the peak resident set size of the process, which never shrinks.
    """

    def __init__(self, device: str) -> None:
        """Note the free memory before any work on the device; the CUDA context exists then."""
        self.device, self.is_gpu = device, torch.device(device).type == "cuda"
        if self.is_gpu:
            prepare_device(device)
            self._free, _ = torch.cuda.mem_get_info(device)

    def used(self) -> float:
        """Return the memory in use [MiB]."""
        if self.is_gpu:
            return (self._free - torch.cuda.mem_get_info(self.device)[0]) / _MIB
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / _MIB

    def clear(self) -> None:
        """Give back the memory that is not in use any more."""
        gc.collect()
        if self.is_gpu:
            torch.cuda.synchronize(self.device)
            torch.cuda.empty_cache()


def measure(task_name: str, cfgs: tuple, memory: MemoryMeter, rounds: int) -> dict[str, Any]:
    """Measure one task of one size; ``cfgs`` are the settings of the task and of its training.

    Timed are ``rounds`` iterations, and physics and step as often.

    Returns:
        The numbers, by names that end in their units; see :func:`summarize`.
    """
    with tempfile.TemporaryDirectory() as folder:
        used: list[float] = []
        with CompileProgress():
            task, runner = build(task_name, cfgs, memory.device, folder)
            while not runner.alg.due():  # a learner may collect for a while before its first update
                runner.collect_rollout()
            time_iterations(runner, WARM_UP, lambda number: used.append(memory.used()))
        times = time_iterations(runner, rounds)
        peak = max(*used, memory.used())
        row = summarize(times, *time_physics(task, rounds), task.num_envs, cfgs[1].runner.num_steps_per_env)
        row["peak_memory_mib"] = peak
    return row


def build(task_name: str, cfgs: tuple, device: str, folder: str) -> tuple[LeggedRobot, OnPolicyRunner]:
    """Return a task of some settings, and its runner, which is ready to train and keeps its run in a folder."""
    env_cfg, train_cfg = cfgs
    set_seed(train_cfg.seed)
    task = task_registry.get_task_class(task_name)(env_cfg, device)
    runner, _ = task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=folder)
    runner.claim_log_dir({})
    wp.synchronize_device(device)
    return task, runner


def time_iterations(runner: OnPolicyRunner, count: int, at_start: Callable[[int], object] | None = None) -> Times:
    """Train for whole iterations as ``train.py`` does, with all logging, and time ``count`` of them.

    One more iteration is run than timed, to show when the last timed one ended. Nothing is printed. ``at_start`` is
    called at the start of each iteration with its number from 0 to ``count``. Ctrl-C, which the runner takes as a
    request to stop early, raises KeyboardInterrupt.
    """
    collect, update = runner.collect_rollout, runner.alg.update
    marks: list[float] = []  # of each iteration: start of the rollout, start and end of the update

    def timed_collect() -> None:
        """Collect a rollout, and mark its start."""
        if at_start:
            at_start(len(marks) // 3)
        marks.append(time.perf_counter())
        collect()

    def timed_update() -> dict[str, float]:
        """Update, and mark start and end."""
        marks.append(time.perf_counter())
        losses = update()
        marks.append(time.perf_counter())
        return losses

    rollouts = patch.object(runner, "collect_rollout", timed_collect)
    updates = patch.object(runner.alg, "update", timed_update)
    try:
        with rollouts, updates, open(os.devnull, "w") as nothing, contextlib.redirect_stdout(nothing):
            runner.learn(count + 1)
    finally:
        if hasattr(runner.logger.writer, "close"):  # rsl_rl leaves tensorboard's open
            runner.logger.writer.close()
    if len(marks) <= 3 * count:
        raise KeyboardInterrupt
    parts = _MS * np.diff(marks[: 3 * count + 1]).reshape(count, 3).T
    columns = zip(("rollout", "update", "log", "iteration"), [*parts, parts.sum(axis=0)], strict=True)
    return {name: values.tolist() for name, values in columns}


def time_physics(task: LeggedRobot, rounds: int) -> tuple[float, float]:
    """Time the physics of one control step alone, torques included, which bounds all else, and ``env.step``.

    Physics restarts from the state that training has left every :data:`PHYSICS_STEPS` control steps: nothing resets
    fallen robots here, and they have more contacts. Returned are the medians over the rounds [ms].
    """
    actions = ACTION_SCALE * torch.randn(task.num_envs, task.num_actions, device=task.device)
    carried = task.sim.state_dict()
    state = [carried[name] for name in ("qpos", "qvel", "qacc_warmstart") if name in carried]
    kept = [tensor.clone() for tensor in state]

    def physics() -> None:
        """Step physics from the kept state."""
        for tensor, values in zip(state, kept, strict=True):
            tensor.copy_(values)
        for _ in range(PHYSICS_STEPS):
            task.run_physics()

    graph = CudaGraph(physics, task.device)
    for _ in range(WARM_UP):
        graph()
    calls = (graph, lambda: task.step(actions))
    times = [[_MS * seconds_per_call(call, task.device) for call in calls] for _ in range(rounds)]
    of_physics, of_step = zip(*times, strict=True)
    return median(of_physics) / PHYSICS_STEPS, median(of_step)


def seconds_per_call(function: Callable[[], object], device: str) -> float:
    """Return the time of one call, with the work that it leaves to the device [s]."""
    calls = GPU_CALLS if torch.device(device).type == "cuda" else 1
    wp.synchronize_device(device)
    start = time.perf_counter()
    for _ in range(calls):
        function()
    wp.synchronize_device(device)
    return (time.perf_counter() - start) / calls


def summarize(times: Times, physics: float, step: float, num_envs: int, num_steps: int) -> dict[str, Any]:
    """Return medians [ms] and steps per second; ``num_steps`` are those of a rollout."""
    medians = {"physics": physics, "step": step} | {name: median(values) for name, values in times.items()}
    return {
        "num_envs": num_envs,
        "num_steps_per_env": num_steps,
        **{f"{name}_ms": value for name, value in medians.items()},
        "iteration_min_ms": min(times["iteration"]),
        "iteration_max_ms": max(times["iteration"]),
        "iteration_steps_per_s": _MS * num_envs * num_steps / medians["iteration"],
    }
