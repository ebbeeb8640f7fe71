"""Base of the settings of trainings: their checks, and the runner that they describe. Needs no torch."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legged_torque.envs.base.distillation_config import DISTILLATION
from legged_torque.envs.base.flashsac_config import FLASHSAC
from legged_torque.envs.base.linear_change import scale_changes
from legged_torque.utils.config import BaseConfig, flat, section_keys, to_dict, update_from_dict
from legged_torque.utils.errors import UserError, check_names, require, unknown_name

if TYPE_CHECKING:
    from rsl_rl.env import VecEnv
    from rsl_rl.runners import OnPolicyRunner

CODE_NAMES = ("class_name", "function", "_func")
"""Ends of the names of settings that name a class or a function, ``"module:Class"`` or a name in rsl_rl."""
PPO = "legged_torque.learning.ppo:OnDevicePPO"
_OF_PPO = ("algorithm.", "actor.", "critic.", "pretraining.file", "pretraining.critic_warmup_iterations")
SECTIONS = (*_OF_PPO, "flashsac.", "distillation.")
READ = {
    PPO: _OF_PPO,
    FLASHSAC: (
        "flashsac.",
        *(f"algorithm.{name}" for name in ("class_name", "gamma", "use_mixed_precision")),
        *(f"algorithm.symmetry_cfg.{name}" for name in ("use_data_augmentation", "data_augmentation_func")),
    ),
    DISTILLATION: ("distillation.", "algorithm.class_name"),
}
"""Beginnings of the paths of those settings that a learner reads; a user's own may read all."""


class TrainingCfg(BaseConfig):
    """Base of the settings of trainings; their sections are those of ``LeggedRobotCfgPPO``."""

    def check(self, path: str = "") -> None:
        """Raise a UserError that names the first setting with a value that is not allowed, alone or with others."""
        super().check(path)
        cfg: Any = self
        rate = cfg.algorithm
        if getattr(rate, "schedule", None) == "adaptive" and rate.learning_rate > rate.max_learning_rate:
            most = f"at most algorithm.max_learning_rate, {rate.max_learning_rate}"
            raise UserError(f"algorithm.learning_rate must be {most}, not {rate.learning_rate}")
        if cfg.pretraining.file and not cfg.pretraining.function:
            raise UserError("pretraining.file is set, but nothing starts from it: pretraining.function is empty")
        for key in ("run_name", "experiment_name"):
            value = getattr(cfg.runner, key)
            if value and (Path(value).name != value or value == ".." or not value.isprintable()):
                raise UserError(f"runner.{key} must be a name, not the path '{value}'")

    def presets(self) -> dict[str, dict[str, Any]]:
        """Return the named changes to the settings of task and training that ``--preset`` chooses from.

        Besides sections with their new values, one may have "linear_changes": a factor on the steps of all of them.
        """
        return {"parallel": {}}

    def use_preset(self, name: str, env_cfg: BaseConfig) -> None:
        """Apply one of the presets to these settings and those of the task; a UserError if there is none."""
        check_names("preset", [name], self.presets())
        changes = dict(self.presets()[name])
        scale_changes(env_cfg, changes.pop("linear_changes", 1.0))
        for section, values in changes.items():
            update_from_dict(env_cfg if section in section_keys(env_cfg) else self, {section: values})

    def upgraded(self, values: dict[str, Any]) -> dict[str, Any]:
        """Return the settings of a run in today's layout; one that lacks ``use_equivariant_networks`` used none."""
        algorithm = values.get("algorithm")
        if not isinstance(algorithm, dict) or not isinstance(algorithm.get("symmetry_cfg"), dict):
            return values
        mirroring = {"use_equivariant_networks": False, **algorithm["symmetry_cfg"]}
        return {**values, "algorithm": {**algorithm, "symmetry_cfg": mirroring}}

    def set_clock(self, ratio: float) -> None:
        """Let discounts and evaluations be of the same time with ``ratio`` control steps in place of one."""
        cfg: Any = self
        for name in ("gamma", "lam"):
            setattr(cfg.algorithm, name, getattr(cfg.algorithm, name) ** (1.0 / ratio))
        cfg.evaluation.num_samples = max(round(cfg.evaluation.num_samples * ratio), 1)

    def refuse_unread(self, paths: Iterable[str]) -> None:
        """Raise a UserError if changed settings, by their dotted ``paths``, are not read by the chosen learner."""
        cfg: Any = self
        learner = cfg.algorithm.class_name
        read = READ.get(learner, SECTIONS)
        for path in paths:
            if path.startswith(SECTIONS) and not path.startswith(read):
                allowed = ", ".join(name.rstrip(".") for name in read)
                raise UserError(f"{path} is not read by {learner}, which reads {allowed}")
            is_of_memory = path in ("distillation.student.rnn_hidden_dim", "distillation.student.rnn_num_layers")
            if is_of_memory and cfg.distillation.student.rnn_type == "none":
                raise UserError(f"{path} is not read: distillation.student.rnn_type is none")

    def check_code_names(self, registered: Iterable[TrainingCfg]) -> None:
        """Refuse, by UserError, names of code that none of the ``registered`` settings or their presets have.

        Settings may come from a stranger's file: a run's ``config.yaml`` or the description of an experiment. Importing
        a name would run any code that is installed. The tasks that are registered are the user's own.
        """
        unknown, known = code_names(to_dict(self)), dict[str, list[Any]]()
        for cfg in registered:
            if not unknown:  # mostly after the first one, of many
                return
            for settings in (to_dict(cfg), *cfg.presets().values()):
                for path, name in code_names(settings).items():
                    known.setdefault(path, []).append(name)
            unknown = {path: name for path, name in unknown.items() if name not in known.get(path, [])}
        for path, name in unknown.items():
            error = unknown_name(path, str(name), {str(other) for other in known.get(path, []) if other})
            raise UserError(f"{error}; these are the names that registered tasks have, register a task to add one")

    def import_code(self) -> None:
        """Import the classes and functions that the settings name, with torch; a UserError if one does not exist."""
        from rsl_rl.utils import resolve_callable

        for path, name in code_names(to_dict(self)).items():
            try:
                if name:
                    resolve_callable(name)
            except (ValueError, ImportError, AttributeError) as error:
                raise UserError(f"{path}: {error}") from None

    def make_runner(self, env: VecEnv, task: str | None, log_dir: str | None) -> OnPolicyRunner:
        """Create the runner of these settings for a task.

        Args:
            env: The task.
            task: Its name, for checkpoints.
            log_dir: Folder of the run; None keeps nothing.
        """
        self.check()
        if log_dir and self.runner.logger == "wandb":  # type: ignore[attr-defined]
            require("wandb", extra="wandb")
        from rsl_rl.utils import resolve_callable

        settings = self.to_rsl_rl()
        # A runner of rsl_rl's own, which a user may register, would run code that a checkpoint holds.
        os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = "1"
        with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints its networks at length
            runner_class = resolve_callable(settings["class_name"])
            return runner_class(env, settings | {"task": task}, log_dir, env.device)

    def to_rsl_rl(self) -> dict[str, Any]:
        """Return the settings in the layout that rsl_rl's runner takes."""
        settings = to_dict(self)
        runner = settings.pop("runner")
        loggers = {
            "tensorboard": {"class_name": "tensorboard"},
            "wandb": {
                "class_name": "legged_torque.learning.training_log:WandbWriter",
                "project_name": runner["wandb_project"],
            },
            "none": {"class_name": "legged_torque.learning.training_log:NoLogWriter"},
        }
        return {**runner, **settings, "logger": loggers[runner["logger"]]}


def code_names(settings: dict[str, Any]) -> dict[str, Any]:
    """Return every setting that names a class or a function, by its dotted path."""
    return {path: name for path, name in flat(settings).items() if path.endswith(CODE_NAMES)}
