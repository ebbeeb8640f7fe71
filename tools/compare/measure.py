"""What is measured on both sides in the same way. It imports neither torch nor rsl_rl, so either environment runs it.

Both train the Go1 on a plane with position control, and both runners are rsl_rl's or have its interface.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any, Protocol

import mujoco
import numpy as np

from legged_torque.utils.metrics import tracking_percentage

YAW_RATE = 0.5  # [rad/s] largest command; the other two are up to 1 m/s
EQUAL = {"cone": "pyramidal", "impratio": 100.0, "iterations": 10, "ls_iterations": 20}
"""MuJoCo's options with ``--settings equal``; physics steps of 5 ms and a decimation of 4 are the defaults of both."""
NETWORKS, NUM_STEPS, EPOCHS, MINIBATCHES = [512, 256, 128], 24, 5, 4  # of both, in all comparisons
INTERVAL = 10  # iterations from checkpoint to checkpoint
ROUNDS, CALLS = 5, 20  # of env.step: timings, and calls in each
ENOUGH = 0.7  # tracking that is waited for
NUM_COMMANDS, SECONDS, RAMP = 24, 8.0, 1.0  # of an evaluation: walks, how long each is, and what of it does not count
_FALLEN = np.cos(np.radians(70.0))  # of the angle between the trunk's axis and the vertical


class Walker(Protocol):
    """A policy that drives its robot in plain MuJoCo."""

    model: mujoco.MjModel
    data: mujoco.MjData
    control_step: float  # [s]

    def reset(self) -> None:
        """Stand in the initial pose, at rest."""

    def step(self, command: np.ndarray) -> None:
        """Make a control step with commanded v_x, v_y [m/s] and yaw rate [rad/s]."""


def tracking(walker: Walker) -> float:
    """Return the mean tracking percentage of :mod:`legged_torque.utils.metrics` over commands that are always the same.

    The first second of each walk does not count; after a fall, nothing is tracked. The first joint is the free one.
    """
    low, high = np.array([1.0, 1.0, YAW_RATE]) * [[-1.0], [1.0]]
    commands = np.random.default_rng(1).uniform(low, high, (NUM_COMMANDS, 3))
    first, last = (round(seconds / walker.control_step) for seconds in (RAMP, SECONDS))
    tracked = np.zeros((NUM_COMMANDS, last))
    matrix = np.zeros(9)
    for number, command in enumerate(commands):
        walker.reset()
        for step in range(last):
            walker.step(command)
            mujoco.mju_quat2Mat(matrix, walker.data.qpos[3:7])
            axes = matrix.reshape(3, 3)
            if not axes[2, 2] > _FALLEN:  # also if it is not a number
                break
            velocity = np.append((axes.T @ walker.data.qvel[:3])[:2], walker.data.qvel[5])
            share, _ = tracking_percentage(np, abs(command - velocity)[None], command[None])
            tracked[number, step] = share[0]
    return float(tracked[:, first:].mean())


class Recorder:
    """Notes start and end of each update of rsl_rl's runner; iterations go from end to end."""

    def __init__(self, runner: Any, started: float) -> None:
        """Watch a runner; the command was given at ``started``, of time.time()."""
        self._times: list[tuple[float, float]] = []  # since then [s]
        update = runner.alg.update

        def timed(*args: Any, **kwargs: Any) -> Any:
            """Update, and note when."""
            start = time.time() - started
            losses = update(*args, **kwargs)
            self._times.append((start, time.time() - started))
            return losses

        runner.alg.update = timed

    def summary(self, num_envs: int) -> dict[str, float]:
        """Return medians over iterations without checkpoints, after the first ones, which compile [ms]."""
        starts, ends = np.transpose(self._times)
        counted = [i for i in range(2, len(ends)) if i % INTERVAL > 1] or [len(ends) - 1]
        iteration = 1e3 * median(ends[i] - ends[i - 1] for i in counted)
        update = 1e3 * median(ends[i] - starts[i] for i in counted)
        steps_per_s = 1e3 * num_envs * NUM_STEPS / iteration
        rates = {"iteration_ms": iteration, "update_ms": update, "training_steps_per_s": steps_per_s}
        return rates | {"start_up_s": self.seconds(1)}

    def seconds(self, iterations: int) -> float:
        """Return the time from the command to the end of an iteration, counted from 1 [s]."""
        return self._times[iterations - 1][1]


def parse_args() -> argparse.Namespace:
    """Return the arguments with which ``python -m tools.compare`` starts a side."""
    parser = argparse.ArgumentParser()
    for name, kind in (("num_envs", int), ("iterations", int), ("seed", int), ("device", str), ("settings", str)):
        parser.add_argument(f"--{name}", type=kind, required=True)
    parser.add_argument("--started", type=float, required=True, help="when the command was given, as time.time()")
    parser.add_argument("--engine", help="of ours")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write; checkpoints go beside it")
    return parser.parse_args()


def step_ms(step: Callable[[], object], synchronize: Callable[[], object]) -> float:
    """Return the median time of one call of env.step [ms]."""
    times = []
    for number in range(1 + ROUNDS):
        synchronize()
        start = time.perf_counter()
        for _ in range(CALLS if number else 2):  # the first ones compile
            step()
        synchronize()
        times.append(1e3 * (time.perf_counter() - start) / CALLS)
    return median(times[1:])


def time_until_enough(recorder: Recorder, walkers: Iterator[tuple[int, Walker]], num_envs: int) -> dict[str, Any]:
    """Return when the first checkpoint tracked enough, with the tracking of all until then.

    ``walkers`` yields numbers of iterations and the policies after them.
    """
    result: dict[str, Any] = {"tracking": []}
    for iterations, walker in walkers:
        share, seconds = tracking(walker), recorder.seconds(iterations)
        print(f"  after {iterations} iterations, {seconds:.1f} s: tracking {share:.3f}", flush=True)
        result["tracking"].append([iterations, seconds, share])
        if share >= ENOUGH:
            return result | {"seconds_to_70": seconds, "steps_to_70": iterations * num_envs * NUM_STEPS}
    return result
