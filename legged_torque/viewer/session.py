"""A task and a trained policy that run live and take requests, without any window or page."""

from __future__ import annotations

import contextlib
import copy
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from legged_torque.learning.runner import OnPolicyRunner
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import apply_perturbation
from legged_torque.utils.runs import checkpoint_numbers
from legged_torque.viewer.pacing import Pacer
from legged_torque.viewer.recording import History, Recorder
from legged_torque.viewer.requests import Requests
from legged_torque.viewer.state import AS_LOADED, State

SCAN_INTERVAL = 1.0
"""Seconds between looks for new checkpoints."""
IDLE = 0.02
"""Seconds between looks for requests while paused."""
SLOWEST, FASTEST = 0.1, 1.0
"""Limits of the speed, in simulated seconds per second."""
SMOOTHING = 0.06
"""Weight of the newest step in the shown reward terms: they are means over about a third of a second."""


class Session(Requests):
    """Steps a task with a policy's mean actions in one thread, which also carries out what others ask for.

    Requests may come from any thread: they only leave a note. The thread in :meth:`run` reads the notes between two
    steps, so that nothing changes in the middle of one. :attr:`state` and :attr:`history` may be read from any thread.
    """

    def __init__(
        self,
        make_task: Callable[[Any], Any],
        env_cfg: Any,
        runner: OnPolicyRunner,
        run_dir: Path,
        checkpoint: int,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Load a checkpoint and be ready to step.

        Args:
            make_task: Builds a task from settings.
            env_cfg: Settings of the runner's task.
            runner: The runner, with its task.
            run_dir: Folder of the run, in which checkpoints are looked for.
            checkpoint: The first one to load.
            clock: Returns the time [s].
            sleep: Waits for some seconds.

        Raises:
            UserError: If the checkpoint cannot be loaded.
        """
        super().__init__()
        self._make_task, self._cfg, self._runner, self._run_dir = make_task, env_cfg, runner, run_dir
        self._clock, self._sleep = clock, sleep
        self._stop = threading.Event()
        self._refused: dict[int, float] = {}
        self._next_scan = -math.inf
        self._falls, self._rewards = 0, np.zeros(0)
        self.history = History()
        self.state = State()
        self.task = runner.env
        self._pacer = Pacer(self.task.dt, clock, sleep)
        self._load(checkpoint)
        self._policy = runner.get_inference_policy(self.task.device)
        self._adopt(self.task)
        self._scan()

    def stop(self) -> None:
        """Let :meth:`run` return after the current step; from any thread."""
        self._stop.set()

    def perturbations(self) -> list[str]:
        """Return what :meth:`set_perturbation` takes."""
        return [AS_LOADED, *self._cfg.perturbations()]

    # ---- the stepping thread -----------------------------------------------------------------------------------------

    def run(self) -> None:
        """Step in time with the clock until :meth:`stop`."""
        while not self._stop.is_set():
            self.tick()

    def tick(self) -> None:
        """Carry out the requests, then make one step when it is due, or none while paused."""
        while not self._requests.empty():
            try:
                self._requests.get()()
            except UserError as error:
                self._tell(str(error), is_error=True)
        if self._clock() >= self._next_scan:
            self._scan()
        if self.state.is_paused:
            self._sleep(IDLE)
            return
        self._pacer.wait()
        self._step()

    @torch.no_grad()
    def _step(self) -> None:
        """Make one control step and show it."""
        self._recorder.before_step()
        self._obs = self.task.step(self._policy(self._obs))[0]
        self.task.total_steps.copy_(self._trained_steps)  # curricula stay where the checkpoint was saved
        world, simulated = self.state.world, self.state.time + self.task.dt
        reading = self._recorder.read(world)
        self.history.add(reading, world, simulated)
        self._rewards += SMOOTHING * (reading.rewards - self._rewards)
        self._falls += int(reading.resets[0])
        self._show(
            reading=reading,
            rewards=dict(zip(self.task.reward_names, self._rewards.tolist(), strict=True)),
            time=simulated,
            real_time=self._pacer.achieved(),
            falls=self._falls,
        )

    def _show(self, **changes: Any) -> None:
        """Replace the state by one with some changes."""
        self.state = State(**{**self.state.__dict__, **changes})

    def _tell(self, message: str, is_error: bool = False) -> None:
        """Show a line."""
        self._show(message=message, is_error=is_error, message_number=self.state.message_number + 1)

    @torch.no_grad()
    def _adopt(self, task: Any) -> None:
        """Go on with a task: the runner's first one, or one that was built with other perturbations."""
        self.task = self._runner.env = task
        self._recorder = Recorder(task)
        self._rewards, self._falls = np.zeros(len(task.reward_names)), 0
        self.history.clear()
        self._show(task_number=self.state.task_number + 1, reading=None, falls=0, rewards={})
        self._set_command(self.state.command)
        self._set_mixing(self.state.mixing if self.state.is_mixing_set else None)
        self._obs = task.reset()
        self._pacer.restart()

    # ---- what requests do --------------------------------------------------------------------------------------------

    def _set_command(self, command: tuple[float, float, float] | None) -> None:
        """Let the task draw commands from a range of one command, or from its own ranges."""
        task = self.task
        task.command_generator.hold(command)
        task.command_generator.resample(torch.ones_like(task.reset_buf))
        self._show(command=command)

    def _push(self, angle: float, speed: float) -> None:
        """Add the velocity, along the horizontal direction in which each trunk looks."""
        w, x, y, z = self.task.base_quat.unbind(dim=1)
        heading = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) + angle
        self.task.sim.qvel[:, 0] += speed * heading.cos()
        self.task.sim.qvel[:, 1] += speed * heading.sin()
        self._tell(f"pushed with {speed:.1f} m/s")

    def _set_paused(self, is_paused: bool) -> None:
        """Stop or go on, without catching up."""
        self._pacer.restart()
        self._show(is_paused=is_paused, real_time=0.0)

    def _reset(self) -> None:
        """Start new episodes."""
        with torch.no_grad():
            self._obs = self.task.reset()
        self._tell("reset")

    def _set_speed(self, speed: float) -> None:
        """Set the speed, within its limits."""
        self._pacer.speed = min(max(speed, SLOWEST), FASTEST)
        self._pacer.restart()
        self._show(speed=self._pacer.speed)

    def _follow_world(self, world: int) -> None:
        """Follow another world."""
        self.history.clear()
        self._rewards[:] = 0.0
        self._show(world=min(max(world, 0), self.task.num_envs - 1))

    def _set_mixing(self, mixing: tuple[float, float] | None) -> None:
        """Write the weights, or let the curriculum write them; they stay, since only rollouts change them."""
        task = self.task
        if not hasattr(task, "mixing"):
            return
        if mixing is None:
            task.update_curriculum()
        else:
            task.mixing.copy_(torch.tensor(mixing, dtype=torch.float32))
        self._show(mixing=tuple(task.mixing.tolist()), is_mixing_set=mixing is not None)

    def _set_perturbation(self, name: str) -> None:
        """Rebuild the task; if that is not possible, the old one goes on."""
        cfg = copy.deepcopy(self._cfg)
        if name != AS_LOADED:
            apply_perturbation(cfg, name)
        self._tell(f"building the worlds with perturbation '{name}' ...")
        old = self.task
        task = self._make_task(cfg)
        task.step_graph.enabled = old.step_graph.enabled
        task.load_state_dict(old.state_dict())
        self._show(perturbation=name)
        self._adopt(task)
        self._tell(f"perturbation '{name}'")

    # ---- checkpoints -------------------------------------------------------------------------------------------------

    def _scan(self) -> None:
        """Look for checkpoints that have appeared, and load the newest one if that is wanted."""
        self._next_scan = self._clock() + SCAN_INTERVAL
        numbers = tuple(checkpoint_numbers(self._run_dir))
        if numbers != self.state.checkpoints:
            self._show(checkpoints=numbers)
        if self.state.follows_newest and numbers and numbers[-1] != self.state.checkpoint:
            changed = self._modified(numbers[-1])
            if self._refused.get(numbers[-1]) != changed:
                self._refused[numbers[-1]] = changed  # not tried again before it changes, should it be broken
                self._ask(self._switch_checkpoint, numbers[-1])

    def _file(self, number: int) -> Path:
        """Return the file of a checkpoint."""
        return self._run_dir / f"model_{number}.pt"

    def _modified(self, number: int) -> float:
        """Return when a checkpoint was written last [s]; -1 if it is gone."""
        try:
            return self._file(number).stat().st_mtime
        except OSError:
            return -1.0

    def _follow_newest(self, is_on: bool) -> None:
        """Load what is newest at the next look, which is due now."""
        self._refused.clear()
        self._next_scan = -math.inf
        self._show(follows_newest=is_on)

    def _switch_checkpoint(self, number: int) -> None:
        """Load another checkpoint while the robots walk on; if it is broken, the old one goes on."""
        actor = self._runner.alg.actor
        weights, counters = copy.deepcopy(actor.state_dict()), self.task.state_dict()
        try:
            self._load(number)
        except UserError:
            actor.load_state_dict(weights)
            self.task.load_state_dict(counters)
            raise
        finally:
            self._set_mixing(self.state.mixing if self.state.is_mixing_set else None)
        self._tell(f"model_{number} acts now")

    def _load(self, number: int) -> None:
        """Load a checkpoint into the networks and its counters into the task."""
        with torch.no_grad():
            infos = self._runner.load(str(self._file(number)))
        self._trained_steps = self.task.total_steps.clone()
        self._show(checkpoint=number, trained_steps=int(infos["total_timesteps"]))


@contextlib.contextmanager
def stopping_on_ctrl_c(session: Session) -> Iterator[None]:
    """While this context is open, Ctrl-C or SIGTERM stops a session; a second Ctrl-C ends the program at once."""

    def stop(number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        session.stop()

    old = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
