"""What a user asks for beyond a task's own settings, as plain values, and how it changes the settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from legged_torque.utils.config import BaseConfig, section_keys, set_by_path, update_from_dict
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.limits import Count, Number, Worlds, check_value, types_of

DEFAULT_TASK = "a1_torque_multihead"
DEFAULT_PRESET = "parallel"
_SET = "change a setting by its dotted path, e.g. rewards.scales.torques=-1e-4; may be repeated"


def _option(help: str, default: Any = None, aliases: tuple[str, ...] = (), **how: Any) -> Any:  # noqa: A002 (argparse's word)
    """Return a field that is also an argument of the command line; ``how`` is what ``add_argument`` takes."""
    return field(default=default, metadata={"help": help, "aliases": aliases, **how})


@dataclass
class Options:
    """The options that scripts share; None leaves a setting as it is.

    Fields tell what they mean by their help, and by their types what they may be, see ``utils.limits``.
    """

    task: str = _option("name of the task, see train.py --list; default: %(default)s", DEFAULT_TASK)
    device: str = _option(
        "auto, cpu or cuda:N; auto takes the GPU if there is one, with torchrun one for each process",
        "auto",
        aliases=("--sim_device", "--rl_device"),  # of legged_gym, where they may differ
    )
    num_envs: Worlds | None = _option(
        "number of worlds, with torchrun those of each process; default: that of the task", type=int
    )
    seed: Number | None = _option("random seed; default: that of the training settings", type=int)
    preset: str | None = _option(
        "training settings: parallel (the default), thorough (three times as long) or paper (Table II)"
    )
    perturbation: str | None = _option(
        "random parameters, pushes and noise: none, low, high, high_frequency or doubled; default: none, or what a "
        "loaded run has"
    )
    ranges: str | None = _option(
        "how far random parameters go: default or hard; default: those of the task, or what a loaded run has"
    )
    task_file: list[str] = field(
        default_factory=list,
        metadata={
            "help": "Python file that registers tasks of your own, which runs as your code; may be repeated",
            "action": "append",
            "metavar": "FILE",
        },
    )
    set: list[str] = field(default_factory=list, metadata={"help": _SET, "action": "append", "metavar": "KEY=VALUE"})
    log_root: str | None = _option("folder that keeps all experiments; default: ./logs")
    experiment_name: str | None = _option("folder of the runs below that; default: name of the task")
    run_name: str | None = _option("added to the name of the run's folder")
    logger: str | None = _option("where curves are written: tensorboard, wandb or none")
    load_run: str | None = _option("run to load: name of its folder or a path; default, and -1: the last one")
    checkpoint: Number | None = _option("checkpoint to load; default, and -1: the last one", type=int)
    resume: bool = _option("continue a run, with its settings", False, action="store_true")
    verbose: bool = _option("print rsl_rl's block of numbers after every iteration", False, action="store_true")
    max_iterations: Count | None = _option(
        "iterations in all, with those before a resume; default: 110e6 environment steps", type=int
    )

    def __post_init__(self) -> None:
        """Take -1 for the last run and the last checkpoint, as legged_gym does."""
        self.load_run = None if str(self.load_run) == "-1" else self.load_run
        self.checkpoint = None if self.checkpoint == -1 else self.checkpoint


def apply_options(
    env_cfg: Any, train_cfg: Any, options: Options, run_config: dict[str, Any] | None = None, on_cpu: bool = False
) -> None:
    """Change settings as the options ask; what is more explicit wins.

    In this order: the preset, the number of worlds that suits the device, ``on_cpu`` or a GPU, the settings of a loaded
    run ("env" and "train" of ``run_config``), the perturbation, the ranges, single options, ``set``. One without sense
    is a UserError. Which device there is, :func:`~legged_torque.utils.devices.resolve_device` tells.
    """
    for name, hint in types_of(Options).items():
        if isinstance(getattr(options, name), int):
            check_value(f"--{name}", getattr(options, name), hint)
    apply_preset(env_cfg, train_cfg, options.preset or DEFAULT_PRESET)
    if on_cpu:
        env_cfg.env.num_envs = env_cfg.env.num_envs_cpu
    if run_config:
        for part, cfg in {"env": env_cfg, "train": train_cfg}.items():
            if not isinstance(run_config[part], dict):
                raise UserError(f"config key '{part}' is a section with entries, not the value {run_config[part]!r}")
            update_from_dict(cfg, cfg.upgraded(run_config[part]))
    if options.perturbation:
        apply_perturbation(env_cfg, options.perturbation)
    if options.ranges:
        _apply_named("ranges", env_cfg.parameter_ranges(), env_cfg, options.ranges)
    for path in ("env.num_envs", "seed", "runner.experiment_name", "runner.run_name", "runner.logger"):
        value = getattr(options, path.rpartition(".")[2])
        if value is not None:
            set_entry_of_either(env_cfg, train_cfg, path, value)
    for item in options.set:
        path, separator, text = item.partition("=")
        if not separator:
            raise UserError(f"--set takes KEY=VALUE, not '{item}'")
        set_entry_of_either(env_cfg, train_cfg, path, text)


def apply_preset(env_cfg: Any, train_cfg: Any, name: str) -> None:
    """Apply the named changes that the training settings offer as their presets."""
    presets = train_cfg.presets()
    if name not in presets:
        raise unknown_name("preset", name, presets)
    for section, values in presets[name].items():
        update_from_dict(env_cfg if section in section_keys(env_cfg) else train_cfg, {section: values})


def apply_perturbation(env_cfg: Any, name: str) -> None:
    """Apply one of the named sets of random events that the task's settings offer; an unknown name is a UserError."""
    _apply_named("perturbation", env_cfg.perturbations(), env_cfg, name)


def _apply_named(kind: str, choices: dict[str, dict], env_cfg: BaseConfig, name: str) -> None:
    """Apply one of several named sets of changes to the task's settings."""
    if name not in choices:
        raise unknown_name(kind, name, choices)
    update_from_dict(env_cfg, choices[name])


def set_entry_of_either(env_cfg: Any, train_cfg: Any, path: str, value: Any) -> None:
    """Set an entry by its dotted path in the task's or the training's settings, whose sections differ in name."""
    section = path.split(".")[0]
    sections = {key: cfg for cfg in (env_cfg, train_cfg) for key in section_keys(cfg)}
    if section not in sections:
        raise unknown_name("config section", section, sections)
    set_by_path(sections[section], path, value)
