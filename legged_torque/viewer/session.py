"""A task and a trained policy that run live and take requests, without any window or page."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Concatenate, ParamSpec

import numpy as np
import torch

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.terrain.rough import RoughGround
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import apply_perturbation
from legged_torque.utils.runs import checkpoint_file, checkpoint_numbers
from legged_torque.utils.task_registry import LoadedRun, task_registry
from legged_torque.viewer.pacing import Pacer
from legged_torque.viewer.reading import Reading, TaskReader, WatchedRobot, watched, weighted_terms
from legged_torque.viewer.state import AS_LOADED, Command, SessionState

HISTORY_STEPS = 500  # control steps that are kept for plots: 10 s
SCAN_INTERVAL = 1.0  # seconds between looks for new checkpoints
IDLE = 0.02  # seconds between looks for requests while paused
SLOWEST, FASTEST = 0.1, 1.0  # limits of the speed, in simulated seconds per second
LARGEST = 100.0  # of all numbers in requests: velocities [m/s, rad/s], angles [rad] and weights
SMOOTHING = 0.06  # weight of the newest step in the shown reward terms: they are means over about a third of a second

Arguments = ParamSpec("Arguments")


def request(method: Callable[Concatenate[Session, Arguments], None]) -> Callable[Concatenate[Session, Arguments], None]:
    """Make a method of :class:`Session` a request: a call is only queued, and :meth:`Session.tick` carries it out."""

    @functools.wraps(method)
    def ask(self: Session, *args: Arguments.args, **kwargs: Arguments.kwargs) -> None:
        self.requests.put(functools.partial(method, self, *args, **kwargs))

    return ask


def check_numbers(what: str, *numbers: float) -> None:
    """Refuse, by UserError, what a page may send in place of its sliders' numbers: NaN, or more than a robot knows."""
    if not all(abs(number) <= LARGEST for number in numbers):
        raise UserError(f"{what} must be of numbers up to {LARGEST:g}, not {', '.join(map(str, numbers))}")


class Session:
    """Steps a task with a policy's mean actions in one thread, which also carries out requests.

    Requests may come from any thread. The thread in :meth:`run` carries them out between two steps, so that nothing
    changes in the middle of one. :attr:`state` and :attr:`history` may be read from any thread.
    """

    def __init__(
        self,
        task_class: type[LeggedRobot],
        run: LoadedRun,
        device: str,
        clock: Callable[[], float] = time.perf_counter,  # [s]
        sleep: Callable[[float], None] = time.sleep,  # [s]
    ) -> None:
        """Build the task, load the checkpoint and be ready to step; a UserError if that cannot be loaded."""
        self._make_task = functools.partial(watched(task_class), device=device)
        self._cfg, self._run_dir = run.env_cfg, run.folder
        self._clock, self._sleep = clock, sleep
        self.requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()  # not carried out yet
        self._stop = threading.Event()
        self.companion: Session | None = None  # steps with this one, under the command of its followed world
        self._refused: dict[int, float] = {}
        self._next_scan = -math.inf
        # The last steps of the followed world; copy it before iterating in another thread.
        self.history: deque[Reading] = deque(maxlen=HISTORY_STEPS)
        self.state = SessionState()  # what is shown
        self.task = self._make_task(self._cfg)  # only the stepping thread may touch its tensors
        self._obs = self.task.get_observations()
        task = run.config.get("task")
        self.name = f"{task}, {run.folder.name}"  # of the run, for users
        self._runner, _ = task_registry.make_alg_runner(self.task, task, train_cfg=run.train_cfg, log_root=None)
        self._pacer = Pacer(self.task.dt, clock, sleep)
        self._load(run.iterations)
        self._policy = self._runner.get_inference_policy(device)
        self._adopt(self.task)
        self._scan()

    def stop(self) -> None:
        """Let :meth:`run` return after the current step; may be called from any thread."""
        self._stop.set()

    def perturbations(self) -> list[str]:
        """Return the names that :meth:`set_perturbation` accepts."""
        return [AS_LOADED, *self._cfg.perturbations()]

    # ---- the stepping thread -----------------------------------------------------------------------------------------

    def run(self) -> None:
        """Step in time with the clock until :meth:`stop`."""
        while not self._stop.is_set():
            self.tick()

    def tick(self) -> None:
        """Carry out the requests, then make one step when it is due, or none while paused."""
        self._prepare()
        if self.state.is_paused:
            self._sleep(IDLE)
            return
        self._pacer.wait()
        self._step()
        if self.companion and self.state.reading:
            v_x, v_y, yaw_rate = self.state.reading.commands[self.state.world].tolist()
            self.companion.follow((v_x, v_y, yaw_rate))

    def follow(self, command: Command) -> None:
        """Make one step under a command, as the companion of another session."""
        if command != self.state.command:
            self.set_command(command)
        self._prepare()
        self._step()

    def _prepare(self) -> None:
        """Carry out the requests, and look for new checkpoints."""
        while not self.requests.empty():
            try:
                self.requests.get()()
            except UserError as error:
                self._tell(str(error), is_error=True)
        if self._clock() >= self._next_scan:
            self._scan()

    @torch.no_grad()
    def _step(self) -> None:
        """Make one control step and show it."""
        self._reader.before_step()
        self._obs = self.task.step(self._policy(self._obs))[0]
        self.task.total_steps.copy_(self._trained_steps)  # curricula stay where the checkpoint was saved
        reading = self._reader.read(self.state.time + self.task.dt, self.state.world)
        self.history.append(reading)
        self._rewards += SMOOTHING * (reading.rewards - self._rewards)
        self._falls += int(reading.resets[0])
        self._show(
            reading=reading,
            rewards=dict(zip(self.task.reward_names, self._rewards.tolist(), strict=True)),
            time=reading.time,
            real_time=self._pacer.achieved(),
            falls=self._falls,
        )

    def _show(self, **changes: Any) -> None:
        """Replace the state by one with some changes."""
        self.state = dataclasses.replace(self.state, **changes)

    def _tell(self, message: str, is_error: bool = False) -> None:
        """Show a line."""
        self._show(message=message, is_error=is_error, message_number=self.state.message_number + 1)

    @torch.no_grad()
    def _adopt(self, task: WatchedRobot) -> None:
        """Go on with a task: the first one, or one that was built with another perturbation."""
        self.task = self._runner.env = task
        self._reader = TaskReader(task)
        self._rewards, self._falls = np.zeros(len(task.reward_names)), 0
        self.history.clear()
        self._show(task_number=self.state.task_number + 1, reading=None, falls=0, rewards={})
        self._apply_command()
        self._apply_mixing()
        self._obs = task.reset()
        self._pacer.restart()

    def _apply_command(self) -> None:
        """Give all worlds the chosen command, or one of their own each."""
        self.task.command_generator.hold(self.state.command)
        self.task.command_generator.resample(torch.ones_like(self.task.reset_buf))

    def _apply_mixing(self) -> None:
        """Set the chosen weights, or those of the curriculum. They stay, since only rollouts change them."""
        self.task.update_curriculum()
        weights = weighted_terms(self.task)
        if self.state.is_mixing_set:
            for name, weight in weights.items():
                weight.fill_(self.state.mixing[name])
        self._show(mixing={name: weight.item() for name, weight in weights.items()})

    # ---- requests: a call from any thread is carried out by the stepping thread --------------------------------------

    @request
    def set_command(self, command: Command | None) -> None:
        """Command v_x, v_y [m/s] and a yaw rate [rad/s] in all worlds; None draws commands as in training."""
        check_numbers("a command", *(command or ()))
        self._show(command=command)
        self._apply_command()

    @request
    def push(self, angle: float, speed: float) -> None:
        """Add a horizontal velocity [m/s] to every trunk at once, in a direction from its front to its left [rad]."""
        check_numbers("a push", angle, speed)
        w, x, y, z = self.task.base_quat.unbind(dim=1)
        heading = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) + angle
        self.task.sim.qvel[:, :2] += speed * torch.stack([heading.cos(), heading.sin()], dim=1)
        if self.companion:
            self.companion.push(angle, speed)
        self._tell(f"pushed with {speed:.1f} m/s")

    @request
    def set_paused(self, is_paused: bool) -> None:
        """Pause, or go on without catching up."""
        self._pacer.restart()
        self._show(is_paused=is_paused, real_time=0.0)

    @request
    def reset(self) -> None:
        """Start a new episode in every world."""
        with torch.no_grad():
            self._obs = self.task.reset()
        if self.companion:
            self.companion.reset()
        self._tell("reset")

    @request
    def set_tile(self, level: int, column: int) -> None:
        """Move the followed robot onto a tile of rough ground, where its episodes start from now on."""
        ground, world = self.task.terrain, self.state.world
        if not isinstance(ground, RoughGround):
            raise UserError("there are no tiles on a plane")
        layout = ground.layout
        ground.levels[world] = min(max(level, 0), layout.num_rows - 1)
        ground.columns[world] = min(max(column, 0), layout.num_cols - 1)
        with torch.no_grad():
            self._obs = self.task.reset(world)
        self._tell(f"robot {world} is on a new tile")

    @request
    def set_speed(self, speed: float) -> None:
        """Set the simulated seconds per second, from :data:`SLOWEST` to :data:`FASTEST`."""
        check_numbers("a speed", speed)
        self._pacer.speed = min(max(speed, SLOWEST), FASTEST)
        self._pacer.restart()
        self._show(speed=self._pacer.speed)

    @request
    def follow_world(self, world: int) -> None:
        """Choose the world of history, torques and reward terms."""
        self.history.clear()
        self._rewards[:] = 0.0
        self._show(world=min(max(world, 0), self.task.num_envs - 1))

    @request
    def set_mixing(self, weights: Sequence[float] | None) -> None:
        """Set the weights of the action terms in ``state.mixing``, in their order; None sets them as in training."""
        check_numbers("a weight", *(weights or ()))
        mixing = self.state.mixing if weights is None else dict(zip(self.state.mixing, weights, strict=True))
        self._show(mixing=mixing, is_mixing_set=weights is not None)
        self._apply_mixing()

    @request
    def load_checkpoint(self, number: int) -> None:
        """Let another checkpoint of the run act while the robots walk on; if it is broken, the old one goes on."""
        actor = self._runner.alg.policy()
        weights, counters = copy.deepcopy(actor.state_dict()), self.task.state_dict()
        try:
            self._load(number)
        except UserError:
            actor.load_state_dict(weights)
            self.task.load_state_dict(counters)
            raise
        finally:
            self._apply_mixing()
        self._tell(f"model_{number} acts now")

    @request
    def follow_newest(self, is_on: bool) -> None:
        """Load each new checkpoint as soon as it is saved, or stop doing so."""
        self._refused.clear()
        self._next_scan = -math.inf  # at once
        self._show(follows_newest=is_on)

    @request
    def set_perturbation(self, name: str) -> None:
        """Rebuild the task with one of its perturbations, or :data:`AS_LOADED`; if that fails, the old one goes on."""
        cfg = copy.deepcopy(self._cfg)
        if name != AS_LOADED:
            apply_perturbation(cfg, name)
        if self.companion:
            self.companion.set_perturbation(name)
        self._tell(f"building the worlds with perturbation '{name}' ...")
        old = self.task
        task = self._make_task(cfg)
        task.step_graph.enabled = old.step_graph.enabled
        task.load_state_dict(old.state_dict())
        if isinstance(task.terrain, RoughGround) and isinstance(old.terrain, RoughGround):
            task.terrain.levels.copy_(old.terrain.levels)
            task.terrain.columns.copy_(old.terrain.columns)
        self._show(perturbation=name)
        self._adopt(task)
        self._tell(f"perturbation '{name}'")

    # ---- checkpoints -------------------------------------------------------------------------------------------------

    def _scan(self) -> None:
        """Look for new checkpoints, and load the newest one if that is wanted."""
        self._next_scan = self._clock() + SCAN_INTERVAL
        numbers = tuple(checkpoint_numbers(self._run_dir))
        if numbers != self.state.checkpoints:
            self._show(checkpoints=numbers)
        if self.state.follows_newest and numbers and numbers[-1] != self.state.checkpoint:
            changed = self._modified(numbers[-1])
            if self._refused.get(numbers[-1]) != changed:
                self._refused[numbers[-1]] = changed  # a broken one is not tried again before it changes
                self.load_checkpoint(numbers[-1])

    def _modified(self, number: int) -> float:
        """Return when a checkpoint was last written [s]; -1 if it is gone."""
        try:
            return checkpoint_file(self._run_dir, number).stat().st_mtime
        except OSError:
            return -1.0

    def _load(self, number: int) -> None:
        """Load a checkpoint into the networks and its counters into the task."""
        with torch.no_grad():
            infos = self._runner.load(str(checkpoint_file(self._run_dir, number)), {"actor": True})
        self._trained_steps = self.task.total_steps.clone()
        self._show(checkpoint=number, trained_steps=int(infos["total_timesteps"]))
