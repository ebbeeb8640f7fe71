"""The log of a training: rsl_rl's curves and printed block, and the display."""

import contextlib
import io
import math
import re
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from rsl_rl.utils import LogWriter
from rsl_rl.utils.logger import Logger
from rsl_rl.utils.wandb_log_writer import WandbLogWriter, wandb

from legged_torque.learning.checkpoint import last_line
from legged_torque.learning.protocols import Task
from legged_torque.learning.training_display import TrainingDisplay
from legged_torque.utils import distributed
from legged_torque.utils.config import BaseConfig, to_dict
from legged_torque.utils.devices import device_name
from legged_torque.utils.display import warn
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import write_errors
from legged_torque.utils.runs import CONFIG_FILE

_STYLES = re.compile("\033\\[[0-9;]*m")  # escape sequences of bold or colored text
_NOT_LOSSES = ("learning_rate", "action_std", "all_skipped")  # numbers of a learner that are logged elsewhere, or not


class TrainingLog:
    """Writes the numbers of each iteration while the device is busy with the next one.

    Attributes:
        display: What shows the training on a terminal or in plain lines.
        broken_pipe: Why nothing can be printed any more, or None.
        steps_per_iteration: Environment steps of an iteration over all processes.
    """

    def __init__(self, env: Task, logger: Logger, cfg: dict[str, Any]) -> None:
        """Prepare for a task, rsl_rl's logger and settings in rsl_rl's layout."""
        self._env, self._logger, self._cfg = env, logger, cfg
        self.steps_per_iteration = distributed.world_size() * env.num_envs * cfg["num_steps_per_env"]
        self.broken_pipe: BrokenPipeError | None = None
        self._iterations = (0, 0)  # the first and the one after the last
        self._verbose = False
        self._unwritten: dict[str, Any] | None = None

    def start(self, first: int, last: int, verbose: bool) -> None:
        """Open the log of iterations ``first`` to ``last``, and create the display, which ``verbose`` silences."""
        with write_errors(Path(self._logger.log_dir or "")), contextlib.redirect_stdout(io.StringIO()):
            self._logger.init_logging_writer()  # which prints a list of its files
        self._iterations, self._verbose = (first, last), verbose
        num_worlds = distributed.world_size() * self._env.num_envs
        title = f"{self._cfg.get('task') or 'training'}: {num_worlds} worlds on {device_name(self._env.device)}"
        is_quiet = verbose or self._logger.writer is None
        folder, steps = str(self._logger.log_dir), self.steps_per_iteration
        ground, rate = getattr(self._env, "terrain", None), round(1.0 / self._env.dt)
        is_known = ground and not ground.map and (num_worlds, rate) == (256, 50)  # where it was measured
        walks_after = self._cfg.get("walks_after", 0) if is_known else 0
        self.display = TrainingDisplay(title, folder, last, first, steps, is_quiet, walks_after=walks_after)

    def prepare(self, iteration: int, times: dict[str, float], numbers: dict[str, float], measured: dict) -> None:
        """Read what else there is to log of an iteration from the device, for :meth:`write`.

        ``numbers`` are the learner's; ``measured`` are logged by the names that they have.
        """
        measured = self._env.log.read(self._env.max_episode_length * self._env.dt) | measured
        if self._logger.writer is None:  # rsl_rl counts what it logs
            self._logger.tot_timesteps += self.steps_per_iteration
            self._logger.tot_time += sum(times.values())
            return
        if "return" in measured:
            self._logger.rewbuffer.append(measured.pop("return"))
            self._logger.lenbuffer.append(measured.pop("length"))
        curricula = self._env.curriculum_values()
        values = torch.stack(list(curricula.values())).tolist() if curricula else []
        measured |= {f"Curriculum/{name}": value for name, value in zip(curricula, values, strict=True)}
        self._logger.ep_extras.append(measured)
        self._unwritten = {"it": iteration, "numbers": numbers, **times}

    def write(self) -> None:
        """Log the iteration that was prepared, which takes milliseconds. An error ends the curves, not the training."""
        log, self._unwritten = self._unwritten, None
        if not log:
            return
        numbers = log.pop("numbers")
        losses = {name: number for name, number in numbers.items() if name not in _NOT_LOSSES}
        shown = {**self._logger.ep_extras[-1], **numbers}
        policy = {name: numbers.get(name, math.nan) for name in ("learning_rate", "action_std")}
        policy["action_std"] = torch.tensor(policy["action_std"])
        first, last = self._iterations
        try:
            with contextlib.redirect_stdout(io.StringIO()) as block:
                self._logger.log(**log, start_it=first, total_it=last, loss_dict=losses, **policy, rnd_weight=None)
        except Exception as error:  # writers raise about anything
            warn(f"logs end here: {last_line(error)}. Training goes on")
            self._logger.writer = NoLogWriter("")
            self._logger.ep_extras.clear()
        if self._logger.rewbuffer:
            shown["Train/mean_reward"] = fmean(self._logger.rewbuffer)
            shown["Train/mean_episode_length"] = fmean(self._logger.lenbuffer) * self._env.dt
        try:
            if self._verbose:
                print(block.getvalue() if sys.stdout.isatty() else _STYLES.sub("", block.getvalue()), flush=True)
            self.display.add_iteration(log["it"] + 1, self._logger.tot_timesteps, shown)
        except BrokenPipeError as error:  # `| head`: ends the training like Ctrl-C
            self.broken_pipe = error

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the returns and lengths of the last episodes, over which the log averages."""
        buffers = {"returns": self._logger.rewbuffer, "lengths": self._logger.lenbuffer}
        return {name: torch.tensor(buffer, dtype=torch.float64) for name, buffer in buffers.items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Continue from a :meth:`state_dict`, which may have further entries."""
        self._logger.rewbuffer.extend(state["returns"].tolist())
        self._logger.lenbuffer.extend(state["lengths"].tolist())


class NoLogWriter(LogWriter):
    """Writes nothing, for ``--logger none``."""

    def __init__(self, log_dir: str) -> None:
        """Accept what rsl_rl passes to a writer."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """Drop the value."""


class WandbWriter(WandbLogWriter):
    """rsl_rl's writer, which uploads what ``--policy wandb:entity/project/run`` loads: settings and checkpoints."""

    def __init__(self, log_dir: str, project_name: str) -> None:
        """Start a run of wandb; a UserError if that refuses, as it does without a key."""
        try:
            super().__init__(log_dir, project_name)
        except wandb.Error as error:
            raise UserError(f"--logger wandb: {error}") from None

    def store_config(self, env_cfg: BaseConfig, train_cfg: dict) -> None:
        """Upload the settings of task and training, for wandb's page as values and for us as the run's file."""
        wandb.config.update({"env_cfg": to_dict(env_cfg), "train_cfg": train_cfg})
        self.save_model(str(Path(self.log_dir, CONFIG_FILE)), 0)

    def save_model(self, model_path: str, it: int) -> None:
        """Upload a file in a folder of the run's name: at the top, wandb's own config.yaml would overwrite ours."""
        wandb.save(model_path, base_path=Path(model_path).parents[1])

    def stop(self) -> None:
        """Upload the videos that were made since the last iteration, and end the run of wandb."""
        for video in Path(self.log_dir).rglob("*.mp4"):
            self.save_video(video, None)
        super().stop()
