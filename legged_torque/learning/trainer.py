"""The training loop, for any learner and task with the members of :mod:`~legged_torque.learning.protocols`."""

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rsl_rl.utils.logger import Logger

from legged_torque.learning import checkpoint
from legged_torque.learning.evaluator import append_row, make_evaluators
from legged_torque.learning.guard import TrainingGuard
from legged_torque.learning.protocols import Learner, Task, Transition, check_learner
from legged_torque.learning.random_state import random_state, restore_random_state
from legged_torque.learning.training_log import TrainingLog
from legged_torque.learning.worlds import Worlds, remove_older_worlds
from legged_torque.sim.graph import MAX_CAPTURED_STEPS, CudaGraph
from legged_torque.utils import distributed
from legged_torque.utils.display import warn
from legged_torque.utils.errors import TrainingError, UserError
from legged_torque.utils.interrupt import StopRequest
from legged_torque.utils.runs import checkpoint_file, checkpoint_number, claim_run_dir, evaluations_file, tagged
from legged_torque.utils.stopwatch import stopwatch

LAST_SHARE = 0.25
"""Most control steps of an evaluation at the end of a training at which none is due, as a share of the training's."""


class Trainer:
    """Trains a learner in a task.

    An iteration is a rollout in all worlds, which replays as one CUDA graph if the learner is capturable, and an
    update. Iterations are counted when they are complete: ``model_<n>.pt`` is the state after n iterations, from which
    training continues as if it had not stopped.

    Processes started by torchrun train one policy, each in worlds of its own. Only the first one prints, logs and
    saves. Logged episodes and tracking are those of its worlds; steps and losses are those of all processes.

    Attributes:
        env: The task.
        alg: The learner.
        logger: rsl_rl's logger, which counts steps and seconds and writes curves.
        current_learning_iteration: Number of complete iterations.
        rollout_graph: A rollout; its graph is enabled where act and observe of the learner can be captured.
        on_checkpoint: Called with the file of each checkpoint of a training.
        stopped_by: Number of the signal that has ended the last training; 0 for none.
        verbose: Whether rsl_rl's block of every iteration is printed, in place of the display.
    """

    def __init__(self, env: Task, alg: Learner, cfg: dict[str, Any], logger: Logger) -> None:
        """Prepare; nothing is written yet.

        Args:
            env: The task.
            alg: The learner.
            cfg: Settings as in rsl_rl's configuration: ``num_steps_per_env``, ``save_interval``, ``capture``, ``seed``,
                ``evaluation`` and, for checkpoints to name it, ``task``.
            logger: rsl_rl's logger. Its folder is created when training starts; None keeps nothing.
        """
        self.env, self.alg, self.cfg, self.logger, self.device = env, alg, cfg, logger, env.device
        env.num_processes = distributed.world_size()
        check_learner(alg, env, env.num_processes if logger.log_dir else 1)  # a policy that is loaded only acts
        if alg.needs_next_obs:
            env.keep_final_observations = True  # type: ignore[attr-defined] # check_learner has seen it
        logger.device = "cpu"  # numbers are read from the device before they are logged
        capture = cfg["capture"] and alg.capturable
        self.rollout_graph = CudaGraph(self._collect, env.device)
        self.rollout_graph.enabled = capture and cfg["num_steps_per_env"] <= MAX_CAPTURED_STEPS
        self._evaluators = make_evaluators(env, alg.policy(), cfg["evaluation"], cfg["seed"], capture)
        self.current_learning_iteration = 0
        self.on_checkpoint: Callable[[Path], None] | None = None
        self.stopped_by = 0
        self.verbose = False
        self._seconds_before = 0.0  # training time before this process
        self._saved_iteration = -1
        self._has_old_worlds = False  # whether the worlds are those of a checkpoint
        self._log = TrainingLog(env, logger, cfg)
        self._background = checkpoint.Background()
        self._worlds = Worlds(env, alg, cfg["evaluation"], [*self._evaluators, self._log])

    @property
    def log_dir(self) -> str | None:
        """Folder of the run; None if nothing is kept."""
        return self.logger.log_dir

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train, and leave a checkpoint. Ctrl-C ends training after the current iteration, a second one at once.

        A call is one training: at its end ``annealing_start`` has made steps small. All processes that train
        together end after the same iteration, whichever is asked to stop, or when torchrun is killed. With
        ``init_at_random_ep_len`` episodes start at random lengths and do not all end at once; those of a checkpoint
        go on as they are.

        Raises:
            TrainingError: Nothing can be learned any more; the checkpoint is written before.
        """
        if init_at_random_ep_len and not self._has_old_worlds:
            high = int(self.env.max_episode_length)
            self.env.episode_length_buf = torch.randint_like(self.env.episode_length_buf, high=high)
        self.alg.policy().train()  # get_inference_policy sets it to evaluation
        if distributed.world_size() > 1:
            self.alg.broadcast_parameters()  # type: ignore[attr-defined] # check_learner has seen it
        first, last = self.current_learning_iteration, self.current_learning_iteration + num_learning_iterations
        guard = TrainingGuard(self.env.health)
        self._log.start(first, last, self.verbose)
        self.save_checkpoint()  # the viewer shows it while the first iterations run
        notify = self._log.display.notify if distributed.rank() == 0 else lambda text: None
        with self._log.display, StopRequest(notify) as stop:
            while self.current_learning_iteration < last and not guard.problem:
                asked = stop.requested or self._log.broken_pipe is not None or distributed.has_lost_parent()
                if distributed.any_process(asked, self.device):
                    break
                self._background.poll()
                begin, stage = time.perf_counter(), "" if self.current_learning_iteration > first else "first iteration"
                self.collect_rollout()
                self._log.write()  # of the last iteration, while the device is busy with this one
                self._wait()
                collected = time.perf_counter()
                stopwatch.lap(stage or "rollouts")
                numbers = self._update(last)
                stopwatch.lap(stage or "updates")
                to_end = num_learning_iterations if self.current_learning_iteration + 1 == last else 0
                measured = self._evaluate(numbers, begin, to_end) | guard.add_iteration(numbers)
                times = {"collect_time": collected - begin, "learn_time": time.perf_counter() - collected}
                stopwatch.lap("evaluations")
                self._log.prepare(self.current_learning_iteration, times, numbers, measured)
                self.current_learning_iteration += 1
                if self.current_learning_iteration % self.cfg["save_interval"] == 0 and not guard.problem:
                    self._begin_checkpoint()
                stopwatch.lap("logs and checkpoints")
            self.save_checkpoint()  # writes the last log too
        self.stopped_by = stop.number
        if self._log.broken_pipe:
            raise self._log.broken_pipe
        if guard.problem:
            raise TrainingError(f"training cannot learn: {guard.problem}")

    def collect_rollout(self) -> None:
        """Let the learner act and observe for one rollout, after curricula that hold for a rollout have moved on."""
        self.env.compile()
        self.env.update_curriculum()
        self.rollout_graph()

    def _collect(self) -> None:
        """Act for one rollout; runs as a CUDA graph."""
        with torch.no_grad():
            obs = self.env.get_observations()
            for _ in range(self.cfg["num_steps_per_env"]):
                actions = self.alg.act(obs)
                after, rewards, dones, extras = self.env.step(actions)
                time_outs, next_obs = extras.get("time_outs"), extras.get("final_observations")
                self.alg.observe(Transition(obs, actions, rewards, dones, time_outs, after, next_obs, extras))
                obs = after

    def _update(self, num_iterations: int) -> dict[str, float]:
        """Let the learner learn if it wants to, and return its numbers."""
        if hasattr(self.alg, "set_progress"):
            self.alg.set_progress(self.current_learning_iteration, num_iterations)
        numbers = self.alg.update() if self.alg.due() else {}
        if not isinstance(numbers, dict):
            raise UserError(f"{type(self.alg).__name__}.update must return a dictionary of numbers, not {numbers}")
        return {name: float(number) for name, number in numbers.items()}

    def _evaluate(self, numbers: dict[str, float], begin: float, ended: int) -> dict[str, float]:
        """Evaluate the policy where it is time, add rows to the run's tables, and return what is to be logged.

        After the last of ``ended`` iterations, which is 0 before, it is time in any case.
        """
        before, most_steps = self.logger.tot_timesteps, int(LAST_SHARE * ended * self.cfg["num_steps_per_env"])
        steps = before + self._log.steps_per_iteration  # without those of a student's teachers, which its task counts
        chosen = {each: each.due(before, steps) for each in self._evaluators if each.due(before, steps, ended > 0)}
        if self.logger.writer is None or not chosen:
            return {}
        self._log.display.activity = "evaluating" if any(chosen.values()) else "evaluating at the end of training"
        start = time.perf_counter()
        seconds = self._seconds_before + self.logger.tot_time + start - begin
        when = {"steps": steps, "iteration": self.current_learning_iteration + 1, "seconds": seconds}
        critic = {name: numbers[name] for name in ("critic_gradient_norm",) if name in numbers}
        logged: dict[str, float] = {}
        for evaluator, is_due in chosen.items():
            metrics, levels = evaluator.evaluate() if is_due else evaluator.evaluate_at_end(most_steps)
            logged |= {f"{tagged('Evaluation', evaluator.name)}/{metric}": value for metric, value in metrics.items()}
            file = evaluations_file(Path(str(self.log_dir)), evaluator.name)
            try:
                append_row(file, {**when, **metrics, **critic, **levels})
            except UserError as error:  # what is learned is worth more than the row
                warn(f"an evaluation is not kept: {error}")
        self._log.display.activity = ""
        return {**logged, "Perf/evaluation_time": time.perf_counter() - start}

    # ---- checkpoints ----------------------------------------------------------------------------------------------

    def save_checkpoint(self) -> None:
        """Save into the run's folder, with all that was logged, and warn if the simulation has dropped contacts."""
        self._begin_checkpoint()
        self._background.finish()

    def _begin_checkpoint(self) -> None:
        """Do as :meth:`save_checkpoint`, but let files be written, with what there is now, while training goes on."""
        self._log.write()
        self._background.finish()
        if self.log_dir is not None and self._saved_iteration != self.current_learning_iteration:
            worlds, state = self._worlds.gather(), self._state({})
            if distributed.rank() == 0:
                file = checkpoint_file(Path(self.log_dir), self.current_learning_iteration)
                work = functools.partial(self._write, file, worlds, checkpoint.on_host(state))
                self._background.start(work, functools.partial(self._announce, file))
            else:
                self._saved_iteration = self.current_learning_iteration
        warning = self.env.check_buffers()
        if warning:
            warn(warning)

    def save(self, path: str, infos: dict | None = None) -> None:
        """Save what training needs to continue, and ``infos``; all processes that train together call it."""
        state = self._state(infos or {})
        if distributed.rank() == 0:
            checkpoint.write(Path(path), state)
            self.logger.save_model(path, self.current_learning_iteration)

    def _state(self, infos: dict) -> dict[str, Any]:
        """Return the content of a checkpoint with these infos, plain values and tensors."""
        state = self.alg.state_dict()
        state["iter"] = self.current_learning_iteration
        state["infos"] = {
            **infos,
            "task": self.env.state_dict(),
            "task_name": self.cfg.get("task"),
            "total_timesteps": self.logger.tot_timesteps,
            "seconds": self._seconds_before + self.logger.tot_time,
            "random_states": distributed.gather(random_state(self.device)),
        }
        return state

    def _write(self, file: Path, worlds: dict[str, Any], state: dict[str, Any]) -> None:
        """Write the worlds of all processes, and then the checkpoint that they belong to."""
        state["infos"]["worlds"] = digest = self._worlds.write(file, worlds)
        checkpoint.write(file, state)
        if digest:
            remove_older_worlds(file)

    def _announce(self, file: Path) -> None:
        """Note that a checkpoint has been written, and tell others."""
        self._saved_iteration = checkpoint_number(file)
        self.logger.save_model(str(file), self._saved_iteration)
        if self.on_checkpoint:
            self.on_checkpoint(file)

    def load(
        self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict:
        """Continue from a checkpoint: learner, counters and with them all curricula; return its infos.

        Arguments are those of rsl_rl's runner, and the device is the task's by default. ``load_cfg`` chooses parts of
        learners with rsl_rl's ``load``; others load all that they have. A UserError if the file is no checkpoint, or
        belongs to another task or kind of policy.
        """
        state = checkpoint.read(Path(path), "checkpoint", map_location or self.device)
        try:
            checkpoint.check_counters(state, path)
            of_task, task = state["infos"].get("task_name"), self.cfg.get("task")
            if of_task and task and of_task != task:  # a runner that is built without a name writes none
                raise UserError(f"checkpoint '{path}' is of task '{of_task}', not '{task}'")
            load_iteration = True
            if hasattr(self.alg, "load"):
                load_iteration = self.alg.load(state, load_cfg, strict)
            else:
                self.alg.load_state_dict(state)
            if load_iteration:
                self.current_learning_iteration = state["iter"]
            self.env.load_state_dict(state["infos"]["task"])
            self.logger.tot_timesteps = state["infos"]["total_timesteps"]
            self._seconds_before = state["infos"]["seconds"]
        except (RuntimeError, KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise UserError(f"checkpoint '{path}' does not fit this task: {checkpoint.last_line(error)}") from None
        return state["infos"]

    def resume(self, path: str) -> None:
        """Continue a training from its checkpoint with its worlds and random numbers; a UserError if it has none.

        If the worlds of the checkpoint are missing or do not fit, they start anew, and a line says why.
        """
        infos = self.load(path)
        try:
            self._worlds.read(Path(path), infos.get("worlds"))
            self._has_old_worlds = True
        except UserError as error:
            for evaluator in self._evaluators:
                evaluator.reset()
            if distributed.rank() == 0:
                kept = ", and what the learner keeps of them" if hasattr(self.alg, "world_state_dict") else ""
                print(f"The worlds start anew{kept}: {error}.")
        self.continue_random_numbers(infos)

    def continue_random_numbers(self, infos: dict) -> None:
        """Continue the random numbers of the run that a checkpoint is from, instead of repeating them.

        Processes beyond those of that run keep their own numbers. A UserError if the infos, from :meth:`load`, lack
        the states of the generators.
        """
        try:
            states = infos["random_states"]
            if distributed.rank() < len(states):
                restore_random_state(self.device, states[distributed.rank()])
        except (KeyError, TypeError, RuntimeError, AttributeError) as error:
            raise UserError(f"the checkpoint has no usable 'random_states': {checkpoint.last_line(error)}") from None

    def claim_log_dir(self, config: dict[str, Any]) -> None:
        """Create the run's folder with its settings, numbered if a run that started in the same second has its name."""
        assert self.log_dir is not None, "nothing is kept of this training"
        self.logger.log_dir = str(claim_run_dir(Path(self.log_dir), config))

    def close(self) -> None:
        """Close the log, and leave the processes that train together, if there are any; training is over then."""
        self.logger.stop_logging_writer()
        if torch.distributed.is_initialized():
            self._wait()
            if hasattr(self.alg, "close"):
                self.alg.close()
            torch.distributed.destroy_process_group()

    def _wait(self) -> None:
        """Wait until the device has done what was asked of it."""
        if torch.device(self.device).type == "cuda":
            torch.cuda.synchronize(self.device)
