"""A task with a trained policy that runs live and takes requests, without any window or page."""

import copy
import functools
import math
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.terrain.rough import RoughGround
from legged_torque.utils.errors import UserError
from legged_torque.utils.math import quat_rotate_yaw
from legged_torque.utils.options import apply_perturbation
from legged_torque.utils.policies import name_of
from legged_torque.utils.runs import checkpoint_file, checkpoint_numbers
from legged_torque.utils.task_registry import LoadedRun, task_registry
from legged_torque.viewer.pacing import Pacer
from legged_torque.viewer.snapshot import Snapshot, WatchedRobot, watched, weighted_terms

HISTORY_STEPS = 500  # control steps that are kept for plots: 10 s
SCAN_INTERVAL = 1.0  # seconds between two looks for new checkpoints
IDLE = 0.02  # seconds between two looks for requests while paused
SLOWEST, FASTEST = 0.1, 1.0  # limits of the speed [simulated seconds per second]
AS_LOADED = "as loaded"  # the perturbation of the run or of the command line

Command = tuple[float, float, float]  # commanded v_x, v_y [m/s] and yaw rate [rad/s]


@dataclass(frozen=True)
class Message:
    """An event in one line."""

    text: str = ""
    is_error: bool = False


def request(method: Callable[..., None]) -> Callable[..., None]:
    """Make a method of :class:`Session` a request: a call is queued, and :meth:`Session.tick` carries it out."""

    @functools.wraps(method)
    def ask(self: "Session", *args: Any) -> None:
        self.requests.append(functools.partial(method, self, *args))

    return ask


class Session:
    """Steps a task with a policy's mean actions and carries out requests in between, all in one thread.

    Requests and :meth:`stop` may be called from any thread. Attributes may be read from any thread, but only the
    stepping thread may touch the task's tensors. ``history`` must be copied before iterating, all others are replaced
    as a whole.
    """

    companion: "Session | None" = None  # another policy, which steps with this one under the followed world's command
    snapshot: Snapshot | None = None  # the last step, and what users have changed since; None before the first
    sim_time = 0.0  # simulated time since the start [s]
    is_paused = False
    world = 0  # the followed world
    falls = 0  # in all worlds since the task was built
    command: Command | None = None  # of all worlds; None: those of the training
    perturbation = AS_LOADED
    chosen_mixing: Sequence[float] | None = None  # weights of action terms that a user has set
    checkpoint = 0  # iterations of the loaded checkpoint
    trained_steps = 0  # its environment steps, without those of a student's teachers
    checkpoints: tuple[int, ...] = ()  # all of the run
    follows_newest = False  # whether new ones are loaded as soon as they are saved
    chosen = ""  # a bundled policy that a user wants to see next
    message = Message()  # the last event

    def __init__(
        self,
        task_class: type[LeggedRobot],
        run: LoadedRun,
        device: str,
        clock: Callable[[], float] = time.perf_counter,  # [s]
        sleep: Callable[[float], None] = time.sleep,  # [s]
    ) -> None:
        """Build the task and load the checkpoint; a UserError if that cannot be loaded."""
        task_registry.check_ranges(run, run.env_cfg)
        self._make_task = functools.partial(watched(task_class), device=device)
        self._run, self._clock, self._sleep = run, clock, sleep
        self._stop, self._next_scan, self._tried = threading.Event(), -math.inf, -1
        self.requests: deque[Callable[[], None]] = deque()  # not carried out yet, the present one included
        self.history: deque[Snapshot] = deque(maxlen=HISTORY_STEPS)  # the last steps of the followed world
        self.mixing: dict[str, float] = {}  # weights of the action terms that have one, by name
        self.task = self._make_task(run.env_cfg)
        self._obs = self.task.get_observations()
        task = run.config.get("task")
        self.name = f"{task}, {run.folder.name}"  # of the run, for users
        self.policy = name_of(run.folder)  # if it is a bundled one
        self._runner, _ = task_registry.make_alg_runner(self.task, task, train_cfg=run.train_cfg, log_root=None)
        self.pacer = Pacer(self.task.dt, clock, sleep)
        self._load(run.iterations)
        self._policy = self._runner.get_inference_policy(device)
        self._adopt(self.task)
        self._scan()

    def stop(self, chosen: str = "") -> None:
        """Let :meth:`run` return after the current step, for the policy ``chosen``; may be called from any thread."""
        self.chosen = chosen
        self._stop.set()

    # ---- the stepping thread -----------------------------------------------------------------------------------------

    def run(self) -> None:
        """Step in real time until :meth:`stop`."""
        while not self._stop.is_set():
            self.tick()

    def tick(self) -> None:
        """Carry out the requests, then make one step when it is due, or none while paused."""
        self.carry_out_requests()
        if self.companion:
            self.companion.carry_out_requests()
        if self.is_paused:
            self._sleep(IDLE)
            return
        self.pacer.wait()
        snapshot = self.step()
        if self.companion:
            v_x, v_y, yaw_rate = snapshot.commands[self.world].tolist()
            if self.companion.command != (v_x, v_y, yaw_rate):
                self.companion.hold((v_x, v_y, yaw_rate))
            self.companion.step()

    def carry_out_requests(self) -> None:
        """Carry out the requests and look for new checkpoints. Errors become messages, and the robots walk on."""
        while self.requests:
            try:
                self.requests[0]()
            except UserError as error:
                self.message = Message(str(error), is_error=True)
            except Exception as error:
                traceback.print_exc()
                self.message = Message(f"{type(error).__name__}: {error}", is_error=True)
            self.requests.popleft()
        if self._clock() >= self._next_scan:
            self._scan()

    @torch.no_grad()
    def step(self) -> Snapshot:
        """Make one control step."""
        self._obs = self.task.step(self._policy(self._obs))[0]
        self.task.total_steps.fill_(self._total_steps)  # curricula stay at the checkpoint's level
        self.snapshot = self.task.snapshot(self.sim_time + self.task.dt, self.world)
        self.history.append(self.snapshot)
        self.sim_time, self.falls = self.snapshot.time, self.falls + self.snapshot.falls
        return self.snapshot

    @torch.no_grad()
    def _adopt(self, task: WatchedRobot) -> None:
        """Continue with a task: the first one, or one with another perturbation."""
        self.task = self._runner.env = task
        self.falls = 0
        self.history.clear()
        self.hold(self.command)
        self._apply_mixing()
        self._obs = task.reset()
        self._look()
        self.pacer.restart()

    def _look(self) -> None:
        """Show what a request has changed, since no step may follow: the session may be paused."""
        if self.snapshot:
            self.snapshot = self.task.snapshot(self.sim_time, self.world)

    def hold(self, command: Command | None) -> None:
        """Command v_x, v_y [m/s] and a yaw rate [rad/s] in all worlds from the next step on; None: as in training."""
        self.command = command
        self.task.command_generator.hold(command or self.task.cfg.commands.fixed)
        self.task.command_generator.update()

    def _apply_mixing(self) -> None:
        """Set the chosen weights, or those of the curriculum. They stay, since only rollouts change them."""
        self.task.update_curriculum()
        weights = weighted_terms(self.task)
        if self.chosen_mixing is not None:
            for weight, chosen in zip(weights.values(), self.chosen_mixing, strict=True):
                weight.fill_(chosen)
        self.mixing = {name: weight.item() for name, weight in weights.items()}

    # ---- requests ----------------------------------------------------------------------------------------------------

    set_command = request(hold)

    @request
    def push(self, angle: float, speed: float) -> None:
        """Add a horizontal velocity [m/s] to every trunk, in a direction from its heading to its left [rad]."""
        push = self.task.base_pos.new_tensor([speed * math.cos(angle), speed * math.sin(angle), 0.0])
        self.task.sim.qvel[:, :3] += quat_rotate_yaw(self.task.base_quat, push.expand(self.task.num_envs, 3))
        if self.companion:
            self.companion.push(angle, speed)
        self.message = Message(f"pushed with {speed:.1f} m/s")

    @request
    def set_paused(self, is_paused: bool) -> None:
        """Pause, or continue without catching up."""
        self.pacer.restart()
        self.is_paused = is_paused

    @request
    def reset(self) -> None:
        """Start a new episode in every world."""
        with torch.no_grad():
            self._obs = self.task.reset()
        self._look()
        if self.companion:
            self.companion.reset()
        self.message = Message("reset")

    @request
    def set_tile(self, level: int, column: int) -> None:
        """Move the followed robot to a tile of rough ground, where its episodes start from now on."""
        ground, world = self.task.terrain, self.world
        if not isinstance(ground, RoughGround):
            raise UserError("there are no tiles on a plane")
        ground.levels[world] = min(max(level, 0), ground.layout.num_rows - 1)
        ground.columns[world] = min(max(column, 0), ground.layout.num_cols - 1)
        begun = self.task.reset_buf.clone()
        with torch.no_grad():
            self._obs = self.task.reset(world)
        self.task.reset_buf.logical_or_(begun)  # policies have not forgotten those episodes yet
        self._look()
        self.message = Message(f"robot {world} is on a new tile")

    @request
    def set_speed(self, speed: float) -> None:
        """Set the simulated seconds per second, from :data:`SLOWEST` to :data:`FASTEST`."""
        self.pacer.speed = min(max(speed, SLOWEST), FASTEST)
        self.pacer.restart()

    @request
    def follow_world(self, world: int) -> None:
        """Choose the world whose values are shown."""
        self.history.clear()
        self.world = min(max(world, 0), self.task.num_envs - 1)
        self._look()

    @request
    def set_mixing(self, weights: Sequence[float] | None) -> None:
        """Set the weights in :attr:`mixing`, in their order; None sets them as in training."""
        self.chosen_mixing = weights
        self._apply_mixing()

    @request
    def load_checkpoint(self, number: int) -> None:
        """Load another checkpoint of the run while the robots walk on; if it is broken, the old policy continues."""
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
        self.message = Message(f"loaded model_{number}")

    @request
    def follow_newest(self, is_on: bool) -> None:
        """Load each new checkpoint as soon as it is saved, or stop doing so."""
        self._next_scan, self._tried = -math.inf, -1  # look at once
        self.follows_newest = is_on

    @request
    def set_perturbation(self, name: str) -> None:
        """Rebuild the task with a perturbation of its settings or :data:`AS_LOADED`; on errors, the old one stays."""
        cfg = copy.deepcopy(self._run.env_cfg)
        if name != AS_LOADED:
            apply_perturbation(cfg, name)
        self.message = Message(f"building the worlds with perturbation '{name}' ...")
        old = self.task
        task = self._make_task(cfg)
        task.step_graph.enabled = old.step_graph.enabled
        task.load_state_dict(old.state_dict())
        if isinstance(task.terrain, RoughGround) and isinstance(old.terrain, RoughGround):
            task.terrain.levels.copy_(old.terrain.levels)
            task.terrain.columns.copy_(old.terrain.columns)
        self.perturbation = name
        self._adopt(task)
        if self.companion:
            self.companion.set_perturbation(name)
        self.message = Message(f"perturbation '{name}'")

    # ---- checkpoints -------------------------------------------------------------------------------------------------

    def _scan(self) -> None:
        """Look for checkpoints, and load the newest one if that is wanted; a broken one is tried once."""
        self._next_scan = self._clock() + SCAN_INTERVAL
        self.checkpoints = tuple(checkpoint_numbers(self._run.folder))
        newest = max(self.checkpoints, default=-1)
        if self.follows_newest and newest not in (self.checkpoint, self._tried):
            self._tried = newest
            self.load_checkpoint(newest)

    def _load(self, number: int) -> None:
        """Load a checkpoint into the networks and its counters into the task."""
        with torch.no_grad():
            self._runner.load(str(checkpoint_file(self._run.folder, number)), {"actor": True})
        self.checkpoint, self.trained_steps = number, int(self._runner.logger.tot_timesteps)
        self._total_steps = int(self.task.total_steps)
