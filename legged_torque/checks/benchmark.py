"""Where the time and the memory of training go."""

from __future__ import annotations

import contextlib
import gc
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean, median
from typing import Any

import torch
import warp as wp

from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.learning.runner import OnPolicyRunner
from legged_torque.sim.graph import CudaGraph, prepare_device
from legged_torque.utils.progress import CompileProgress
from legged_torque.utils.task_registry import set_seed

WARM_UP = 2
"""Iterations until all is ready: the first one runs as it is and compiles, the second one captures the rollout."""
TRACED = 2
"""Iterations in a trace."""
PHYSICS_STEPS = 5
"""Control steps of physics that are timed in a row: the copies before them cost little, and no robot falls so soon."""
TOP_KERNELS = 10
"""Kernels that are told of a trace."""
_MIB = 2**20


@dataclass
class Plan:
    """What to measure.

    Attributes:
        rounds: How many iterations are timed, and how often physics and step are.
        endurance: Iterations in a row to look for slow-down and growth; 0 leaves that out.
        trace: File for a trace of :data:`TRACED` iterations; None leaves that out.
    """

    rounds: int
    endurance: int = 0
    trace: Path | None = None


@dataclass
class Times:
    """Milliseconds of iterations in a row, one entry each.

    Attributes:
        rollout: Curriculum, and the rollout with its returns.
        update: The update.
        log: Reading the task's numbers, printing and writing them, and saving checkpoints that are due.
        iteration: The sum: from the start of one iteration to the start of the next one.
    """

    rollout: list[float] = field(default_factory=list)
    update: list[float] = field(default_factory=list)
    log: list[float] = field(default_factory=list)
    iteration: list[float] = field(default_factory=list)


class MemoryMeter:
    """How much memory this process takes.

    On a GPU: by how much the free memory of the device has shrunk since the meter was created. That counts all of
    torch (what its allocator holds, graphs), of Warp (which has a pool of its own that torch does not see), and kernels
    that were loaded; it does not count the CUDA context, which is there before. It also counts what other processes
    have taken or given back in the meantime: measure on a GPU of your own. Allocators keep what they have taken, graphs
    above all, so that the most that is seen between iterations is what training needs.

    On the CPU: the peak resident set size of the process, which never shrinks.
    """

    def __init__(self, device: str) -> None:
        """Take the memory that is free now as that of a device without our work."""
        self._device = torch.device(device)
        self._free = 0
        if self._device.type == "cuda":
            prepare_device(device)
            self._free = torch.cuda.mem_get_info(self._device)[0]

    def used(self) -> float:
        """Return the memory in use [MiB]."""
        if self._device.type == "cuda":
            return (self._free - torch.cuda.mem_get_info(self._device)[0]) / _MIB
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / _MIB

    def shares(self) -> dict[str, float]:
        """Return what torch's allocator holds at most, and what Warp's pool has in use; nothing on the CPU [MiB]."""
        if self._device.type != "cuda":
            return {}
        result = {"torch_memory_mib": torch.cuda.max_memory_reserved(self._device) / _MIB}
        if wp.is_mempool_supported(str(self._device)):
            result["warp_memory_mib"] = wp.get_mempool_used_mem_current(str(self._device)) / _MIB
        return result

    def clear(self) -> None:
        """Give back what the last size has taken, as far as it is not in use any more."""
        gc.collect()
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(self._device)


def measure(task_name: str, env_cfg: Any, train_cfg: Any, plan: Plan, memory: MemoryMeter, device: str) -> dict:
    """Measure one task of one size in all respects.

    Args:
        task_name: Name of the task.
        env_cfg: Its settings.
        train_cfg: Settings of its training.
        plan: What to measure.
        memory: The meter of the device.
        device: "cpu" or "cuda:N".

    Returns:
        The numbers, by names that end in their units; only "num_envs" and "error" if it does not fit in memory.
    """
    try:
        return _measure(task_name, env_cfg, train_cfg, plan, memory, device)
    except Exception as error:
        if not is_out_of_memory(error):
            raise
    return {"num_envs": env_cfg.env.num_envs, "error": "does not fit in memory"}


def _measure(task_name: str, env_cfg: Any, train_cfg: Any, plan: Plan, memory: MemoryMeter, device: str) -> dict:
    """Do what :func:`measure` says for a size that fits."""
    with tempfile.TemporaryDirectory() as folder:
        marks, used = [time.perf_counter()], []

        def mark(number: int = 0) -> None:
            marks.append(time.perf_counter())
            used.append(memory.used())

        with CompileProgress() as compilation:
            set_seed(train_cfg.seed)
            task = task_registry.get_task_class(task_name)(env_cfg, device)
            runner, _ = task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=folder)
            runner.claim_log_dir()
            _wait(task)
            mark()
            time_iterations(runner, WARM_UP, mark)
        times = time_iterations(runner, plan.rounds)
        peak = {"peak_memory_mib": max(*used, memory.used()), **memory.shares()}
        physics, step = time_physics(task, plan.rounds)
        row = summarize(times, physics, step, task.num_envs, train_cfg.runner.num_steps_per_env)
        row |= {**peak, **summarize_startup(marks), "compiled_modules": compilation.modules}
        if plan.endurance:
            row["endurance"] = endure(runner, plan.endurance, memory)
        if plan.trace:
            row["kernels"] = trace_iterations(runner, plan.trace)
    return row


def time_iterations(
    runner: OnPolicyRunner, count: int, at_start: Callable[[int], object] = lambda number: None
) -> Times:
    """Train for whole iterations as ``train.py`` does, with everything that is logged, and time them.

    One more iteration is run than timed: it shows when the last one ended. What is printed goes nowhere.

    Args:
        runner: The runner.
        count: How many iterations are timed.
        at_start: Called at the start of each iteration with its number from 0 to ``count``.

    Raises:
        KeyboardInterrupt: If Ctrl-C was pressed, which the runner takes for a wish to stop early.
    """
    collect, update = runner.collect_rollout, runner.alg.update
    started, collected, updated = [], [], []

    def timed_collect() -> None:
        at_start(len(started))
        started.append(time.perf_counter())
        with torch.profiler.record_function("rollout"):
            collect()

    def timed_update() -> dict[str, float]:
        collected.append(time.perf_counter())
        with torch.profiler.record_function("update"):
            losses = update()
        updated.append(time.perf_counter())
        return losses

    runner.collect_rollout, runner.alg.update = timed_collect, timed_update
    try:
        with open(os.devnull, "w") as nothing, contextlib.redirect_stdout(nothing):
            runner.learn(count + 1)
    finally:
        del runner.collect_rollout, runner.alg.update
        if hasattr(runner.logger.writer, "close"):  # rsl_rl leaves tensorboard's open
            runner.logger.writer.close()
    if len(started) <= count:
        raise KeyboardInterrupt
    times = Times()
    for i in range(count):
        times.rollout.append(1e3 * (collected[i] - started[i]))
        times.update.append(1e3 * (updated[i] - collected[i]))
        times.log.append(1e3 * (started[i + 1] - updated[i]))
        times.iteration.append(1e3 * (started[i + 1] - started[i]))
    return times


def time_physics(task: LeggedRobot, rounds: int) -> tuple[float, float]:
    """Time one control step in turns: its physics steps alone, the floor under everything else, and ``env.step``.

    Physics starts anew from the state that training has left every :data:`PHYSICS_STEPS` control steps, since lying
    robots, which nobody resets here, have more contacts.

    Args:
        task: The task.
        rounds: How often each is timed.

    Returns:
        Medians of the milliseconds of the physics steps and of ``env.step``.
    """
    actions = 0.5 * torch.randn(task.num_envs, task.num_actions, device=task.device)
    state = (task.sim.qpos, task.sim.qvel, task.sim.qacc_warmstart)
    kept = [tensor.clone() for tensor in state]

    def physics() -> None:
        for tensor, values in zip(state, kept, strict=True):
            tensor.copy_(values)
        decimation = task.cfg.control.decimation
        for i in range(PHYSICS_STEPS * decimation):
            task.sim.step(sense=(i + 1) % decimation == 0)

    graph = CudaGraph(physics, task.device)
    repeats = 20 if torch.device(task.device).type == "cuda" else 1
    for _ in range(2):  # compile and capture
        graph()
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        times[0].append(_milliseconds(graph, repeats, task) / PHYSICS_STEPS)
        times[1].append(_milliseconds(lambda: task.step(actions), repeats, task))
    return median(times[0]), median(times[1])


def summarize(times: Times, physics: float, step: float, num_envs: int, num_steps: int) -> dict:
    """Return medians with what follows from them: steps per second, and ratios to physics alone.

    Args:
        times: Those of whole iterations.
        physics: Milliseconds of the physics steps of one control step.
        step: Milliseconds of ``env.step``.
        num_envs: Number of worlds.
        num_steps: Control steps of a rollout.
    """
    rollout, iteration = median(times.rollout), median(times.iteration)
    return {
        "num_envs": num_envs,
        "num_steps_per_env": num_steps,
        "physics_ms": physics,
        "step_ms": step,
        "rollout_ms": rollout,
        "update_ms": median(times.update),
        "log_ms": median(times.log),
        "iteration_ms": iteration,
        "iteration_min_ms": min(times.iteration),
        "iteration_max_ms": max(times.iteration),
        "step_over_physics": step / physics,
        "iteration_over_physics": iteration / (physics * num_steps),
        "physics_steps_per_s": 1e3 * num_envs / physics,
        "step_steps_per_s": 1e3 * num_envs / step,
        "rollout_steps_per_s": 1e3 * num_envs * num_steps / rollout,
        "iteration_steps_per_s": 1e3 * num_envs * num_steps / iteration,
    }


def summarize_startup(marks: list[float]) -> dict[str, float]:
    """Return the seconds that pass before training runs at full speed.

    Args:
        marks: When building began, when it ended, and when each iteration began [s]. The first one loads kernels and
            compiles what is not in the cache, which in a process that measures several sizes the first size pays.

    Returns:
        "build_s": task and runner. "log_s": opening the log. "first_iteration_s", and "capture_s" of the second one.
        "startup_s": all together.
    """
    names = ("build_s", "log_s", "first_iteration_s", "capture_s")
    parts = {name: end - begin for name, begin, end in zip(names, marks[:-1], marks[1:], strict=True)}
    return {**parts, "startup_s": marks[-1] - marks[0]}


def endure(runner: OnPolicyRunner, count: int, memory: MemoryMeter) -> dict[str, float]:
    """Run many iterations in a row and compare the first tenth of them with the last one.

    Returns:
        Mean milliseconds of an iteration in both tenths, and the memory at the end of both [MiB].
    """
    tenth = max(1, count // 10)
    used: dict[int, float] = {}

    def look(number: int) -> None:
        if number in (tenth, count):
            used[number] = memory.used()

    times = time_iterations(runner, count, look).iteration
    first, last = mean(times[:tenth]), mean(times[-tenth:])
    return {
        "iterations": count,
        "first_ms": first,
        "last_ms": last,
        "slowdown": last / first - 1.0,
        "first_memory_mib": used[tenth],
        "last_memory_mib": used[count],
        "growth_mib": used[count] - used[tenth],
    }


def trace_iterations(runner: OnPolicyRunner, file: Path) -> list[dict]:
    """Write a trace of :data:`TRACED` whole iterations that Perfetto and Chrome open.

    Args:
        runner: The runner, warmed up.
        file: The file to write, compressed if its name ends in ".gz".

    Returns:
        What :func:`most_expensive` tells.
    """
    cuda = torch.device(runner.device).type == "cuda"
    activity = torch.profiler.ProfilerActivity
    schedule = torch.profiler.schedule(wait=0, warmup=1, active=TRACED, repeat=1)
    with torch.profiler.profile(activities=[activity.CPU, *[activity.CUDA] * cuda], schedule=schedule) as profiler:
        time_iterations(runner, 1 + TRACED, lambda number: profiler.step() if number else None)
    profiler.export_chrome_trace(str(file))
    return most_expensive(profiler.key_averages(), cuda)


def most_expensive(entries: Iterable[Any], cuda: bool) -> list[dict]:
    """Return what has taken most time in a trace: kernels and copies of a GPU, or torch's operators on the CPU.

    torch's profiler sees Warp's kernels on a GPU only.

    Args:
        entries: The profiler's averages by name.
        cuda: Whether the work ran on a GPU.

    Returns:
        Names, numbers of calls and total milliseconds without that of nested calls, the most expensive first.
    """
    kind, total = ("CUDA", "self_device_time_total") if cuda else ("CPU", "self_cpu_time_total")
    rows = [
        {"name": entry.key, "calls": entry.count, "total_ms": 1e-3 * getattr(entry, total)}
        for entry in entries
        if entry.device_type.name == kind and not entry.is_user_annotation
    ]
    return sorted(rows, key=lambda row: row["total_ms"], reverse=True)[:TOP_KERNELS]


def is_out_of_memory(error: BaseException | None) -> bool:
    """Return whether an error, or one that led to it, says that memory has run out."""
    words = ("out of memory", "Failed to allocate", "can't allocate memory")  # CUDA, Warp, torch on the CPU
    while error is not None:
        if isinstance(error, MemoryError | torch.OutOfMemoryError):
            return True
        if isinstance(error, RuntimeError) and any(word in str(error) for word in words):
            return True
        error = error.__cause__ or error.__context__
    return False


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
