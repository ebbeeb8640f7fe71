"""rsl_rl's on-policy runner, with rollouts that never wait for the host and crash-safe checkpoints."""

from __future__ import annotations

import contextlib
import io
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from rsl_rl import runners

import legged_torque
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.learning import checkpoint
from legged_torque.learning.evaluator import TrainingEvaluators, append_row
from legged_torque.learning.guard import TrainingGuard
from legged_torque.learning.log_writer import NoLogWriter
from legged_torque.learning.ppo import OnDevicePPO
from legged_torque.learning.random_state import random_state, restore_random_state
from legged_torque.learning.training_display import TrainingDisplay
from legged_torque.learning.worlds import (
    check_identity,
    identity,
    pack,
    read_worlds,
    remove_other_worlds,
    unpack,
    world_tensors,
    write_worlds,
)
from legged_torque.sim.graph import MAX_CAPTURED_STEPS, CudaGraph
from legged_torque.utils import distributed
from legged_torque.utils.devices import device_name
from legged_torque.utils.display import warn
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.files import write_errors
from legged_torque.utils.interrupt import StopRequest
from legged_torque.utils.runs import checkpoint_file, claim_run_dir, evaluations_file, tagged

_STYLES = re.compile("\033\\[[0-9;]*m")  # what makes text bold or colored on a terminal


class OnPolicyRunner(runners.OnPolicyRunner):
    """Trains a policy in a :class:`~legged_torque.envs.base.legged_robot.LeggedRobot` task.

    On a GPU a whole rollout replays as one CUDA graph. Iterations are counted when they are complete:
    ``model_<n>.pt`` is the state after n iterations, from which training continues as if it had not stopped.

    Processes started by torchrun train one policy, each in worlds of its own; only the first one prints, logs and
    saves. What is logged of episodes and tracking is that of its worlds, steps and losses are those of all processes.
    """

    env: LeggedRobot
    alg: OnDevicePPO

    def __init__(self, env: LeggedRobot, train_cfg: dict, log_dir: str | None = None, device: str = "cpu") -> None:
        """Create the runner, with settings in rsl_rl's layout and on the task's device, "cpu" or "cuda:N".

        The folder of the run, ``log_dir``, is created when training starts; None keeps nothing. A UserError if a
        network reads observations that the task does not have, or processes that train together do not find each other.
        """
        torch.set_float32_matmul_precision("high")  # TF32 on a GPU
        for key, groups in train_cfg["obs_groups"].items():
            for group in groups or [""]:
                if group not in env.obs_buf:
                    raise unknown_name(f"observation group in obs_groups.{key}", group, map(str, env.obs_buf.keys()))
        super().__init__(env, train_cfg, log_dir, device)
        self._evaluators = TrainingEvaluators(env, self.alg.actor, self.cfg["evaluation"], self.cfg["seed"])
        self.logger.device = "cpu"  # where numbers are averaged that are on the host anyway
        self.logger.git_status_repos = [legged_torque.__file__]  # whose uncommitted changes a run's folder keeps
        self.log_dir = log_dir
        self.on_checkpoint: Callable[[Path], None] | None = None  # called with each checkpoint of a training
        self.stopped_by = 0  # number of the signal that has ended the last training; 0: none
        self._seconds_before = 0.0  # training time before this process
        self._saved_iteration = -1  # that of the last checkpoint
        self._worlds_go_on = False  # whether they are those of a checkpoint
        self._unwritten_log: dict | None = None
        self._log_is_broken = False
        self._nobody_reads: BrokenPipeError | None = None  # why nothing can be printed any more
        self.verbose = False  # whether rsl_rl's block of every iteration is printed, in place of the display
        self._display = self._new_display(0)
        env.num_processes = self.gpu_world_size
        env.step_graph.enabled = self.alg.update_graph.enabled = self.cfg["capture"]
        enabled = self.cfg["capture"] and self.cfg["num_steps_per_env"] <= MAX_CAPTURED_STEPS
        self._rollout = CudaGraph(self._collect, device, enabled)

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train, and leave a checkpoint; Ctrl-C ends training after the current iteration, a second one at once.

        A call is one training: it is at its end that ``algorithm.annealing_start`` lets steps be small.
        All processes that train together end after the same iteration, whichever of them is asked to stop. If episodes
        start at random lengths, they do not all end at once; those of a checkpoint go on as they are. A TrainingError,
        after the checkpoint, if nothing can be learned any more.
        """
        if init_at_random_ep_len and not self._worlds_go_on:
            high = int(self.env.max_episode_length)
            self.env.episode_length_buf = torch.randint_like(self.env.episode_length_buf, high=high)
        self.alg.train_mode()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        with write_errors(Path(self.log_dir or "")), contextlib.redirect_stdout(io.StringIO()):  # it lists its files
            self.logger.init_logging_writer()
        start_it = self.current_learning_iteration
        total_it = start_it + num_learning_iterations
        guard = TrainingGuard(self.env, self.alg)
        warmup = self.cfg["pretraining"]["critic_warmup_iterations"]
        self.save_checkpoint()  # so that there is something to see at once
        self._display = self._new_display(total_it)
        with self._display, StopRequest(self._display.notify) as stop:
            for _ in range(num_learning_iterations):
                if distributed.any_process(stop.requested or self._nobody_reads is not None, self.device):
                    break
                start = time.perf_counter()
                self.collect_rollout()
                self._write_log()  # of the last iteration, while the device is busy with this one
                self._wait()
                collected = time.perf_counter()
                self.alg.learn_actor(self.current_learning_iteration >= warmup)
                self.alg.anneal(self.current_learning_iteration / total_it)
                losses = self.alg.update()
                measured = self._evaluate(losses, start) | guard.add_iteration(losses["skipped_updates"])
                learned = time.perf_counter()
                times = {"collect_time": collected - start, "learn_time": learned - collected}
                self._prepare_log(start_it, total_it, times, losses, measured)
                self.current_learning_iteration += 1
                if guard.problem:
                    break
                if self.current_learning_iteration % self.cfg["save_interval"] == 0:
                    self.save_checkpoint()
            self.save_checkpoint()  # writes the last log too
        self.stopped_by = stop.number
        self.logger.stop_logging_writer()
        if self._nobody_reads:
            raise self._nobody_reads
        guard.check()

    def claim_log_dir(self, config: dict[str, Any]) -> None:
        """Create the run's folder with its settings, numbered if a run that started in the same second has its name."""
        assert self.log_dir is not None, "nothing is kept of this training"
        self.log_dir = self.logger.log_dir = str(claim_run_dir(Path(self.log_dir), config))

    def close(self) -> None:
        """Leave the processes that train together, if there are any; training is over then."""
        if torch.distributed.is_initialized():
            self._wait()
            self.alg.update_graph.reset()  # NCCL waits for the end of graphs with its work in them
            torch.distributed.destroy_process_group()

    def save(self, path: str, infos: dict | None = None) -> None:
        """Save all that training needs to continue, and ``infos``; all processes that train together call it."""
        state = self.alg.save()
        state["iter"] = self.current_learning_iteration
        state["infos"] = {
            **(infos or {}),  # plain values and tensors
            "task": self.env.state_dict(),
            "task_name": self.cfg.get("task"),
            "total_timesteps": self.logger.tot_timesteps,
            "seconds": self._seconds_before + self.logger.tot_time,
            "random_states": distributed.gather(random_state(self.device)),
        }
        if self.gpu_global_rank > 0:
            return
        checkpoint.write(Path(path), state)
        self.logger.save_model(path, self.current_learning_iteration)

    def load(
        self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict:
        """Continue from a checkpoint: networks, optimizer, counters and with them all curricula; return its infos.

        Arguments are those of rsl_rl's runner, whose device is the default. A UserError if the file is not a checkpoint
        or belongs to another task or kind of policy.
        """
        state = checkpoint.read(Path(path), "checkpoint", map_location or self.device)
        try:
            checkpoint.check_counters(state, path)
            of_task, task = state["infos"].get("task_name"), self.cfg.get("task")
            if of_task and task and of_task != task:  # older checkpoints do not name theirs
                raise UserError(f"checkpoint '{path}' is of task '{of_task}', not '{task}'")
            load_iteration = self.alg.load(state, load_cfg, strict)
            if load_iteration:
                self.current_learning_iteration = state["iter"]
            self.env.load_state_dict(state["infos"]["task"])
            self.logger.tot_timesteps = state["infos"]["total_timesteps"]
            self._seconds_before = state["infos"]["seconds"]
        except (RuntimeError, KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise UserError(f"checkpoint '{path}' does not fit this task: {checkpoint.last_line(error)}") from None
        return state["infos"]

    def resume(self, path: str) -> None:
        """Continue a training from its checkpoint, random numbers included; a UserError if it has none.

        If the worlds of the checkpoint are missing or do not fit, they start anew, and a line says why.
        """
        infos = self.load(path)
        try:
            self._restore_worlds(Path(path), infos.get("worlds"))
        except UserError as error:
            self._evaluators.clear()
            if self.gpu_global_rank == 0:
                print(f"The worlds start anew: {error}.")
        self.continue_random_numbers(infos)

    def continue_random_numbers(self, infos: dict) -> None:
        """Go on with the random numbers of the run that a checkpoint is from, instead of repeating them.

        Processes beyond those of that run keep their own numbers. A UserError if the infos, from :meth:`load`, do not
        say where the random numbers stood.
        """
        try:
            states = infos["random_states"]
            if self.gpu_global_rank < len(states):
                restore_random_state(self.device, states[self.gpu_global_rank])
        except (KeyError, TypeError, RuntimeError, AttributeError) as error:
            raise UserError(f"the checkpoint has no usable 'random_states': {checkpoint.last_line(error)}") from None

    def collect_rollout(self) -> None:
        """Let curricula that hold for a rollout move on, and fill the storage with one rollout and its returns."""
        self.env.compile()
        self.env.update_curriculum()
        self._rollout()

    def _collect(self) -> None:
        """Act for one rollout; runs as a CUDA graph."""
        with torch.no_grad():
            obs = self.env.get_observations()
            for _ in range(self.cfg["num_steps_per_env"]):
                actions = self.alg.act(obs)
                obs, rewards, dones, extras = self.env.step(actions)
                self.alg.process_env_step(obs, rewards, dones, extras)
            self.alg.compute_returns(obs)

    def _configure_multi_gpu(self) -> None:
        """Join the processes that torchrun has started; rsl_rl's own method knows only GPUs."""
        self.gpu_world_size, self.gpu_global_rank = distributed.world_size(), distributed.rank()
        self.gpu_local_rank = distributed.local_rank()
        self.is_distributed = self.gpu_world_size > 1
        self.cfg["multi_gpu"] = None
        if self.is_distributed:
            distributed.join(self.device)
            ranks = {"global_rank": self.gpu_global_rank, "local_rank": self.gpu_local_rank}
            self.cfg["multi_gpu"] = {**ranks, "world_size": self.gpu_world_size}

    def _wait(self) -> None:
        """Wait until the device has done what was asked of it."""
        if torch.device(self.device).type == "cuda":
            torch.cuda.synchronize(self.device)

    def _evaluate(self, losses: dict, iteration_start: float) -> dict[str, float]:
        """Measure the policy where it is time, note it in the run's folder, and return what is to be logged."""
        steps = int(self.env.total_steps)
        before = steps - self.cfg["num_steps_per_env"] * self.env.num_envs * self.gpu_world_size
        due = self._evaluators.due(before, steps)
        if self.logger.writer is None or not due:
            return {}
        self._display.activity = "evaluating"
        start = time.perf_counter()
        seconds = self._seconds_before + self.logger.tot_time + start - iteration_start
        when = {"steps": steps, "iteration": self.current_learning_iteration + 1, "seconds": seconds}
        levels = {name: float(level) for name, level in self.env.terrain.curriculum_values().items()}
        logged: dict[str, float] = {}
        for name in due:
            metrics = self._evaluators.get(name).evaluate()
            logged |= {f"{tagged('Evaluation', name)}/{metric}": value for metric, value in metrics.items()}
            row = {**when, **metrics, "critic_gradient_norm": losses["critic_gradient_norm"], **levels}
            assert self.log_dir is not None  # there is a writer only where something is kept
            try:
                append_row(evaluations_file(Path(self.log_dir), name), row)
            except UserError as error:  # training goes on: what is learned is worth more
                warn(f"an evaluation is not kept: {error}")
        self._display.activity = ""
        return {**logged, "Perf/evaluation_time": time.perf_counter() - start}

    def _new_display(self, total_it: int) -> TrainingDisplay:
        """Return what shows a training; it is quiet where nothing is kept, and if rsl_rl's block is printed."""
        num_worlds = self.gpu_world_size * self.env.num_envs
        place = device_name(self.env.device)
        title = f"{self.cfg.get('task') or 'training'}: {num_worlds} worlds on {place}"
        is_quiet = self.verbose or self.logger.writer is None
        steps = num_worlds * self.cfg["num_steps_per_env"]
        return TrainingDisplay(title, str(self.log_dir), total_it, self.current_learning_iteration, steps, is_quiet)

    def _prepare_log(self, start_it: int, total_it: int, times: dict, losses: dict, measured: dict) -> None:
        """Read the numbers of one iteration from the device, for :meth:`_write_log`."""
        numbers = self.env.log.read(self.env.max_episode_length * self.env.dt) | measured
        if self.logger.writer is None:
            return
        if "return" in numbers:
            self.logger.rewbuffer.append(numbers.pop("return"))
            self.logger.lenbuffer.append(numbers.pop("length"))
        curricula = self.env.curriculum_values()
        values = torch.stack(list(curricula.values())).tolist() if curricula else []
        numbers |= {f"Curriculum/{name}": value for name, value in zip(curricula, values, strict=True)}
        self.logger.ep_extras.append(numbers)
        progress = {"it": self.current_learning_iteration, "start_it": start_it, "total_it": total_it, **times}
        policy = {"learning_rate": float(self.alg.learning_rate), "action_std": self.alg.action_std().cpu()}
        self._unwritten_log = {**progress, **policy, "loss_dict": losses, "rnd_weight": None}

    def _write_log(self) -> None:
        """Log the previous iteration; takes milliseconds. What goes wrong is told, and training goes on without it."""
        log, self._unwritten_log = self._unwritten_log, None
        if not log:
            return
        numbers = {**self.logger.ep_extras[-1], **log["loss_dict"], "learning_rate": log["learning_rate"]}
        numbers["noise"] = log["action_std"].mean().item()
        try:
            with contextlib.redirect_stdout(io.StringIO()) as block:
                self.logger.log(**log)
        except Exception as error:  # what writes curves raises about anything
            if not self._log_is_broken:
                warn(f"logs end here: {checkpoint.last_line(error)}. Training goes on")
            self._log_is_broken, self.logger.writer = True, NoLogWriter("")
            self.logger.ep_extras.clear()
        if self.logger.rewbuffer:
            numbers["reward"] = fmean(self.logger.rewbuffer)
            numbers["length"] = fmean(self.logger.lenbuffer) * self.env.dt
        try:
            if self.verbose:
                print(block.getvalue() if sys.stdout.isatty() else _STYLES.sub("", block.getvalue()), flush=True)
            self._display.add_iteration(log["it"] + 1, self.logger.tot_timesteps, numbers)
        except BrokenPipeError as error:  # | head: as good as Ctrl-C
            self._nobody_reads = error

    def save_checkpoint(self) -> None:
        """Save into the run's folder with all that was logged, and warn if the simulator had too little room."""
        self._write_log()
        if self.log_dir is not None and self._saved_iteration != self.current_learning_iteration:
            file = checkpoint_file(Path(self.log_dir), self.current_learning_iteration)
            digest = self._save_worlds(file)
            self.save(str(file), {"worlds": digest})
            self._saved_iteration = self.current_learning_iteration
            if digest:
                remove_other_worlds(file)
            if self.on_checkpoint:
                self.on_checkpoint(file)
        warning = self.env.sim.check_buffers()
        if warning:
            warn(warning)

    def _save_worlds(self, file: Path) -> str:
        """Write the worlds of all processes, which belong to a checkpoint, and return their digest.

        Empty in all processes but the first, and if they cannot be written: the checkpoint is worth more.
        """
        mine = {
            "worlds": pack(world_tensors(self.env), self.env.num_envs),
            **self._evaluators.state(),
            "returns": torch.tensor(self.logger.rewbuffer, dtype=torch.float64),
            "lengths": torch.tensor(self.logger.lenbuffer, dtype=torch.float64),
        }
        processes = distributed.gather(mine)
        if self.gpu_global_rank > 0:
            return ""
        try:
            return write_worlds(file, {**identity(self.env, self.cfg["evaluation"]), "processes": processes})
        except UserError as error:
            warn(f"worlds would start anew in a resumed run: {error}")
            return ""

    def _restore_worlds(self, file: Path, digest: str | None) -> None:
        """Go on with the worlds that belong to a checkpoint; a UserError, and no world changed, if they do not fit."""
        content = read_worlds(file, digest)
        try:
            check_identity(content, identity(self.env, self.cfg["evaluation"]))
            processes = content["processes"]
            if len(processes) != self.gpu_world_size:
                raise UserError(f"{len(processes)} processes have trained, now there are {self.gpu_world_size}")
            mine = processes[self.gpu_global_rank]
            self._evaluators.load_state(mine)
            unpack(mine["worlds"], world_tensors(self.env), self.env.num_envs)
            self.logger.rewbuffer.extend(mine["returns"].tolist())
            self.logger.lenbuffer.extend(mine["lengths"].tolist())
        except (RuntimeError, KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise UserError(f"their file is not as it should be: {checkpoint.last_line(error)}") from None
        self._worlds_go_on = True
