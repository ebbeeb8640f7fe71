"""The options that scripts share, as plain values, and the changes that they make to settings."""

import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from legged_torque.utils.config import checked_path, section_keys, set_by_path, update_from_dict
from legged_torque.utils.errors import UserError, check_names
from legged_torque.utils.limits import Count, Number, Rate, Worlds, check_value, types_of
from legged_torque.utils.plain_yaml import parse_yaml

DEFAULT_PRESET = "parallel"
CPU_PRESET = "laptop"  # chosen where there is no GPU
DEFAULT_TASK = "a1_torque_multihead"
MOTOR_FILES = (".yaml", ".yml")
OF_MOTORS = ("motors", "domain_rand")  # sections that such files may have
LAW = "motors.chain (control law)"
PUSH = "push_velocity"
CONTACT = ("contact_stiffness", "contact_damping")  # which are drawn together
DELAYS = {"action_delay": "motors.delay.range", "sensing_delay": "sensing.delay.range"}
"""What ``evaluate.py --sweep`` takes besides parameters of ``domain_rand``: pushes, and delays with their settings."""


def _option(text: str, default: Any = None, **how: Any) -> Any:
    """Return a field that is an option of the command line as well, with its help and further words of argparse."""
    return field(default_factory=lambda: copy.copy(default), metadata={"help": text, **how})


@dataclass
class Options:
    """The options that scripts share; None leaves a setting as it is.

    The type of a field bounds its values, see ``utils.limits``, and makes it a number, a flag or a list for argparse.
    """

    task: str = _option("name of the task, see train.py --list; default: %(default)s", DEFAULT_TASK)
    device: str = _option(
        "auto, cpu or cuda:N; auto takes the GPU if there is one, with torchrun one for each process",
        "auto",
        aliases=("--sim_device", "--rl_device"),  # of legged_gym, where they may differ
    )
    num_envs: Worlds | None = _option(
        "worlds, in each process of several, as of torchrun or the preset laptop; default: that of the task or script"
    )
    seed: Number | None = _option("random seed; default: that of the training settings; to play and evaluate: 1")
    preset: str | None = _option(
        "training settings: parallel (the default on a GPU), laptop (that on a CPU), thorough (330 million steps), "
        "paper (Table II), flashsac (another learner) or student (imitates distillation.teachers)"
    )
    perturbation: str | None = _option(
        "random parameters, pushes and noise: none, low, high, high_frequency or doubled; default: none, or what a "
        "loaded run has"
    )
    ranges: str | None = _option("how far random parameters go: default or hard; default: as in the task or loaded run")
    motors: str | None = _option(
        "models of the motors: ideal, real, or another of the robot's motors.choices, or a YAML file of identify.py; "
        "default: those of the task, or what a loaded run has"
    )
    policy_hz: Rate | None = _option("control steps per second; default: 50, or those of the task or the loaded run")
    physics_hz: Rate | None = _option("physics steps per second; default: 200, or those of the task or the loaded run")
    task_file: list[str] = _option(
        "Python file that registers tasks of your own, which runs as your code; may be repeated", [], metavar="FILE"
    )
    set: list[str] = _option("change a setting, rewards.scales.torques=-1e-4; may be repeated", [], metavar="KEY=VALUE")
    log_root: str | None = _option("folder that keeps all experiments; default: ./logs")
    experiment_name: str | None = _option("folder of the runs below that; default: name of the task")
    run_name: str | None = _option("added to the name of the run's folder")
    logger: str | None = _option("where curves are written: tensorboard, wandb or none")
    load_run: str | None = _option("run to load: name of its folder or a path; default, and -1: the last one")
    policy: str | None = _option("bundled policy, such as go2/torque_multihead, in place of a run; not to train")
    checkpoint: Number | None = _option("checkpoint to load; default, and -1: the last one")
    resume: bool = _option("continue a run, with its settings", False)
    verbose: bool = _option("print rsl_rl's block of numbers after every iteration", False)
    max_iterations: Count | None = _option("iterations, those before a resume included; default: by runner.total_steps")

    def __post_init__(self) -> None:
        """Take -1 for the last run and the last checkpoint, as legged_gym does."""
        self.load_run = None if str(self.load_run) == "-1" else self.load_run
        self.checkpoint = None if self.checkpoint == -1 else self.checkpoint


def apply_options(env_cfg: Any, train_cfg: Any, options: Options, run_config: dict[str, Any] | None = None) -> None:
    """Change settings as the options say; a UserError names a value that is not allowed.

    The more explicit wins: a preset is overridden by the settings of a loaded run ("env" and "train" of
    ``run_config``), these by the clocks, then by perturbation, ranges and motors, single options, and ``set``.
    """
    for name, hint in types_of(Options).items():
        if isinstance(getattr(options, name), (int, float)):
            check_value(f"--{name}", getattr(options, name), hint)
    train_cfg.use_preset(options.preset or DEFAULT_PRESET, env_cfg)
    if run_config:
        for part, cfg in {"env": env_cfg, "train": train_cfg}.items():
            if not isinstance(run_config[part], dict):
                raise UserError(f"config key '{part}' is a section with entries, not the value {run_config[part]!r}")
            update_from_dict(cfg, cfg.upgraded(run_config[part]))
    if options.policy_hz or options.physics_hz:
        train_cfg.set_clock(env_cfg.set_clocks(options.policy_hz, options.physics_hz))
    if options.perturbation:
        apply_perturbation(env_cfg, options.perturbation)
    if options.ranges:
        update_from_dict(env_cfg, _named("ranges", options.ranges, env_cfg.parameter_ranges()))
    if options.motors:
        choose_motors(env_cfg, options.motors)
    paths = ("env.num_envs", "seed", "runner.experiment_name", "runner.run_name", "runner.logger")
    changes = [(path, value) for path in paths if (value := getattr(options, path.rpartition(".")[2])) is not None]
    for item in options.set:
        path, separator, text = item.partition("=")
        if not separator:
            raise UserError(f"--set takes KEY=VALUE, not '{item}'")
        changes.append((path, text))
    sections = {key: cfg for cfg in (env_cfg, train_cfg) for key in section_keys(cfg)}
    for path, value in changes:
        section = path.split(".")[0]
        checked_path("", section, list(sections))
        set_by_path(sections[section], path, value)
    train_cfg.refuse_unread(path for path, _ in changes)


def refuse_of_trainings(paths: Iterable[str], what: str, env_cfg: Any) -> None:
    """Raise a UserError if a setting, by its dotted path, is not one of the task: loaded policies read no others."""
    sections = section_keys(env_cfg)
    for path in paths:
        if path.split(".")[0] not in sections:
            raise UserError(f"{what} cannot set {path}, which is for trainings; allowed: {', '.join(sections)}")


def choose_motors(env_cfg: Any, name: str) -> str:
    """Choose a chain of motors by its name, or take settings of motors and of what is drawn at random from a YAML file.

    Returns the delay that a file has set, by the name of its link, that of the chain first; empty without one. A
    UserError if there is no such chain or file, or the file holds anything else.
    """
    if not name.endswith(MOTOR_FILES):
        env_cfg.motors.choose(name)
        return ""
    try:
        values = parse_yaml(Path(name).read_text("utf-8"), f"'{name}'")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read the settings of motors in '{name}': {error}") from None
    if not isinstance(values, dict):
        raise UserError(f"'{name}' must hold the sections {' and '.join(OF_MOTORS)}")
    check_names(f"section of '{name}'", values, OF_MOTORS)
    rand, fixed = env_cfg.domain_rand, list(env_cfg.domain_rand.keep_fixed)
    update_from_dict(env_cfg, values)
    rand.keep_fixed = [*fixed, *(each for each in rand.keep_fixed if each not in fixed)]
    links, given = env_cfg.motors, values.get("motors", {})
    known = (name for name in (*links.chain, *given) if name in given)
    return next((name for name in known if hasattr(getattr(links, name), "counted")), "")


def law_of_motors(env_cfg: Any) -> dict[str, list[str]]:
    """Return, under the name :data:`LAW`, the links of the chain of motors that belong to the control law."""
    motors = env_cfg.motors
    return {LAW: [name for name in motors.chain if getattr(getattr(motors, name, None), "_of_law", False)]}


def simulated_latency(env_cfg: Any, motors: str, latency: float | None) -> float:
    """Choose motors as :func:`choose_motors`, and return by how much commands are late [s]: ``latency`` [ms], if given.

    If not, what a file of motors says; a UserError if that is not one time.
    """
    if (name := choose_motors(env_cfg, motors)) and latency is None:
        clock = env_cfg.sim.dt, env_cfg.control.decimation
        return getattr(env_cfg.motors, name).seconds(f"motors.{name} of '{motors}'", *clock)
    return (latency or 0.0) / 1e3


def apply_perturbation(env_cfg: Any, name: str) -> None:
    """Apply one of the named sets of random events that a task's settings offer; an unknown name is a UserError."""
    update_from_dict(env_cfg, _named("perturbation", name, env_cfg.perturbations()))


def without_effect(env_cfg: Any, changes: Iterable[str]) -> Iterator[str]:
    """Yield a line for those changes, as ``--set`` has them, of what a task never draws since it is switched off."""
    if not hasattr(env_cfg, "domain_rand"):  # a task of another kind
        return
    rand, paths = env_cfg.domain_rand, [change.partition("=")[0] for change in changes]
    switches = {
        "domain_rand.randomize_parameters": [f"domain_rand.{name}" for name in env_cfg.random_parameters()],
        "domain_rand.push_robots": [f"domain_rand.{name}" for name in vars(rand) if name.startswith("push_")],
        "noise.add_noise": [f"noise.{name}" for name in vars(env_cfg.noise)],
    }
    for switch, names in switches.items():
        idle = [path for path in paths if path != switch and ".".join(path.split(".")[:2]) in names]
        section, _, name = switch.partition(".")
        if idle and not getattr(getattr(env_cfg, section), name):
            yield f"{', '.join(idle)} has no effect without {switch}=true"


def draw_only(env_cfg: Any, name: str) -> None:
    """Let a task draw a random parameter, and no other where it draws none; an unknown name is a UserError.

    Motors and tasks draw parameters of their own where parameters are drawn: those stay as they are, too.
    """
    rand, names = env_cfg.domain_rand, env_cfg.random_parameters()
    check_names("random parameter", [name], [*names, *DELAYS, PUSH])
    if name == PUSH:
        rand.push_robots = False  # the sweep pushes
    freed = CONTACT if name in CONTACT else (name,)
    if name in names and not rand.randomize_parameters:
        rand.randomize_parameters, rand.keep_fixed, rand._swept = True, list(names), freed
    rand.keep_fixed = [other for other in rand.keep_fixed if other not in freed]


def _named(kind: str, name: str, choices: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return one of several named sets of changes."""
    check_names(kind, [name], choices)
    return choices[name]
