"""The registry of tasks, as in legged_gym.

Tasks from outside the package are in files that a command line names and in modules of installed packages. Both run
their author's code, so the user names or installs them; nothing that a run or an experiment has written does.
"""

from __future__ import annotations

import contextlib
import copy
import importlib
import importlib.metadata
import math
import pkgutil
import sys
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legged_torque import resource_path
from legged_torque.utils import distributed, runs
from legged_torque.utils.config import BaseConfig
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.errors import UserError, printable, unknown_name
from legged_torque.utils.files import importable, remove_stale_parts
from legged_torque.utils.options import Options, apply_options, refuse_of_trainings
from legged_torque.utils.policies import policy_dir

if TYPE_CHECKING:
    from rsl_rl.env import VecEnv
    from rsl_rl.runners import OnPolicyRunner

LOGS = "logs"  # default folder of all experiments
ENTRY_POINTS = "legged_torque.tasks"
"""Group of the entry points of installed packages, each of a module that registers tasks."""


@dataclass
class LoadedRun:
    """A run of an earlier training."""

    folder: Path
    config: dict[str, Any]  # contents of its config.yaml
    env_cfg: Any  # settings of its task, changed by the options
    train_cfg: Any  # settings of its training, changed by the options
    checkpoint: Path  # the one that the options name

    @property
    def iterations(self) -> int:
        """Iterations after which the checkpoint was saved."""
        return runs.checkpoint_number(self.checkpoint)

    @property
    def task(self) -> str:
        """Name of its task."""
        return str(self.config["task"])


class TaskRegistry:
    """Tasks by name: a task class, its settings, and the settings of its training."""

    def __init__(self) -> None:
        """Start empty."""
        self._tasks: dict[str, tuple[type[VecEnv] | str, Any, Any]] = {}
        self._looks_for_installed = True  # whether nothing has asked yet for tasks that other packages may have

    def register(self, name: str, task_class: type[VecEnv] | str, env_cfg: BaseConfig, train_cfg: BaseConfig) -> None:
        """Make a task known that is created as ``task_class(env_cfg, device)``.

        A UserError if another task has the name, an argument is of another kind, or names of settings are mistaken.

        Args:
            name: Name of the task.
            task_class: Its class, or ``"module:Class"``, which is imported when the task is built.
            env_cfg: Settings of the task.
            train_cfg: Settings of its training, of a :class:`~legged_torque.envs.base.training_config.TrainingCfg`.
        """
        if not isinstance(name, str):
            raise UserError(f"the name of a task must be a text, not {name!r}")
        if name in self._tasks:
            raise UserError(f"'{name}' is a task already; choose another name")
        wrong = [cfg for cfg in (env_cfg, train_cfg) if not isinstance(cfg, BaseConfig)]
        if not wrong:
            type(env_cfg).refuse_mistakes(type(train_cfg))
            wrong = [cfg for cfg, section in ((env_cfg, "env"), (train_cfg, "runner")) if not hasattr(cfg, section)]
        if wrong:
            raise UserError(f"the settings of task '{name}' must be instances of configurations, not {wrong[0]!r}")
        self._tasks[name] = (task_class, env_cfg, train_cfg)

    def import_files(self, files: Iterable[str | Path]) -> None:
        """Import Python files that register tasks, each once.

        A file is imported by its name, and its folder becomes the last place to import from: it may use files next to
        it, and settings may name its classes, ``"my_task:MyRobot"``. A UserError says why a file cannot be used.
        """
        for file in map(Path, files):
            name = importable(file, "--task_file")
            if name not in sys.modules:
                with self._adding(f"'{file}'"):
                    importlib.import_module(name)

    def names(self) -> list[str]:
        """Return the names of all tasks, in the order of their registration, those of installed packages last."""
        self._import_installed()
        return list(self._tasks)

    def get_task_class(self, name: str) -> type[VecEnv]:
        """Return the class of a task; a UserError if the task is not known, or its class cannot be found."""
        task_class = self._get(name)[0]
        try:
            found = pkgutil.resolve_name(task_class) if isinstance(task_class, str) else task_class
        except (ValueError, AttributeError, ModuleNotFoundError) as error:
            raise UserError(f"the class of task '{name}' cannot be found: {error}") from error
        if not isinstance(found, type):
            raise UserError(f"the class of task '{name}' must be a class, not {found!r}")
        return found

    def get_cfgs(self, name: str, args: Options | None = None, run_config: dict | None = None) -> tuple[Any, Any]:
        """Return copies of the settings of a task and its training, or of a loaded run's, as ``args`` change them.

        With ``args``, a UserError names the first value that is not allowed, before torch and the classes that the
        settings name are imported.
        """
        env_cfg, train_cfg = (copy.deepcopy(cfg) for cfg in self._get(name)[1:])
        train_cfg.runner.experiment_name = train_cfg.runner.experiment_name or name
        if args is None:
            return env_cfg, train_cfg
        apply_options(env_cfg, train_cfg, args, run_config)
        env_cfg.check()
        train_cfg.check()
        train_cfg.check_code_names([registered for _, _, registered in self._tasks.values()])
        on_cpu = resolve_device(args.device) == "cpu"  # imports torch
        train_cfg.import_code()
        is_given = args.num_envs is not None or any(item.startswith("env.num_envs=") for item in args.set)
        is_kept = run_config is not None and "num_envs" in run_config["env"].get("env", {})
        if on_cpu and not is_given and not is_kept:
            env_cfg.env.num_envs = env_cfg.env.num_envs_cpu
        return env_cfg, train_cfg

    def get_new_cfgs(self, options: Options) -> tuple[Any, Any]:
        """Return the settings of a task and a training that begins, as the options change them.

        Those of a student's task are the first teacher's, also how long a control step is. A UserError if there is no
        such teacher, or one is of another task.
        """
        env_cfg, train_cfg = self.get_cfgs(options.task, options)
        files = find_teachers(train_cfg, options.log_root)
        if not files:
            return env_cfg, train_cfg
        for file in reversed(files):  # the first one last
            config = runs.load_config(file.parent)
            if config["task"] != options.task:
                raise UserError(f"the run '{file.parent}' is of task '{config['task']}', not '{options.task}'")
        if "cpu" in (resolve_device(options.device), config.get("device")):  # which has fewer worlds than a GPU
            with contextlib.suppress(KeyError, TypeError):  # of a broken file, of which get_cfgs says what is wrong
                del config["env"]["env"]["num_envs"]
        config["train"] = {}
        known = (env_cfg, self.get_cfgs(options.task, Options(device=options.device), config)[0])
        own, teachers = (cfg.sim.dt * cfg.control.decimation for cfg in known)
        train_cfg.set_clock(own / teachers)
        evaluation = {"num_samples": train_cfg.evaluation.num_samples}
        config["train"] = {"evaluation": evaluation, "pretraining": {"function": ""}}  # it does not start from one
        env_cfg, train_cfg = self.get_cfgs(options.task, options, config)
        train_cfg.distillation.teachers = list(map(str, files))
        return env_cfg, train_cfg

    def make_env(self, name: str, args: Options | None = None, env_cfg: Any | None = None) -> tuple[VecEnv, Any]:
        """Create a task on the device of ``args``; return it and its settings.

        ``env_cfg`` are settings to use as they are; None takes the registered ones with ``args`` applied. Notes of the
        task on its robot are printed.
        """
        task_class = self.get_task_class(name)
        if env_cfg is None:
            env_cfg, _ = self.get_cfgs(name, args)
        env = task_class(env_cfg, resolve_device(args.device if args else None))
        print_notes(getattr(env, "notes", ()))
        return env, env_cfg

    def make_alg_runner(
        self,
        env: VecEnv,
        name: str | None = None,
        args: Options | None = None,
        train_cfg: Any | None = None,
        log_root: str | Path | None = "default",
    ) -> tuple[OnPolicyRunner, Any]:
        """Create the runner that trains or holds a policy, and return it and its settings; nothing is written yet.

        Args:
            env: The task.
            name: Name of the task, which checkpoints keep and must agree in; may be left out if ``train_cfg`` is given.
            args: With ``resume``, the checkpoint that ``load_run`` and ``checkpoint`` name is loaded.
            train_cfg: Settings to use as they are; None takes the registered ones with ``args`` applied.
            log_root: Folder of the experiment's runs; "default" is ``logs/<experiment name>``, None keeps nothing.
        """
        if train_cfg is None:
            if name is None:
                raise ValueError("make_alg_runner needs a task's name or its train_cfg")
            _, train_cfg = self.get_cfgs(name, args)
        default = experiment_dir(train_cfg, args.log_root if args else None)
        root = default if log_root == "default" else log_root and Path(log_root)
        log_dir = str(runs.new_run_dir(root, train_cfg.runner.run_name)) if root else None
        runner = train_cfg.make_runner(env, name, log_dir)
        if args is not None and args.resume:
            folder = runs.find_run(root or default, args.load_run)
            remove_stale_parts(folder)
            runner.resume(str(runs.find_checkpoint(folder, args.checkpoint)))
        return runner, train_cfg

    def load_run(self, options: Options) -> LoadedRun:
        """Return the run that the options name, by default the last one; one of all tasks if they name none.

        A UserError if there is none, it is unreadable or of another task.
        """
        if options.policy and options.load_run:
            raise UserError("--policy and --load_run exclude each other")
        chosen = str(policy_dir(options.policy, options.checkpoint)) if options.policy else options.load_run
        experiment = options.experiment_name
        if options.task and not experiment:
            experiment = self.get_cfgs(options.task)[1].runner.experiment_name
        root, pattern = Path(options.log_root or LOGS, experiment or ""), "*" if experiment else "*/*"
        folder = runs.find_run(root, chosen, pattern)
        config = runs.load_config(folder)
        task = str(config["task"])
        if options.task and task != options.task:
            raise UserError(f"the run '{folder}' is of task '{task}', not '{options.task}'")
        cfgs = self.get_cfgs(task, options, config)
        if not options.resume:
            refuse_of_trainings((item.partition("=")[0] for item in options.set), "--set", cfgs[0])
        robot, trained = cfgs[0].asset.file, config["env"].get("asset", {}).get("file", cfgs[0].asset.file)
        if robot != trained:
            from legged_torque.utils.mjcf import robot_notes  # which imports mujoco

            print_notes(robot_notes(resource_path(robot), resource_path(trained)))
        file = runs.find_checkpoint(folder, options.checkpoint)
        others = filter(runs.checkpoint_numbers, root.glob(pattern))
        are_newer = not chosen and any(runs.by_age(other) > runs.by_age(folder) for other in others)
        is_last = runs.checkpoint_number(file) == runs.checkpoint_numbers(folder)[-1]
        if are_newer or (options.checkpoint is None and not is_last):
            print(f"Newer checkpoints than '{file}' are damaged; taking this one.")
        return LoadedRun(folder, config, *cfgs, file)

    def make_loaded(self, run: LoadedRun, options: Options, env_cfg: Any = None) -> tuple[VecEnv, OnPolicyRunner]:
        """Create the task of a run, and a runner that holds the policy of its checkpoint and keeps nothing.

        ``env_cfg`` are settings of the task in place of the run's; its critic may see other things, as it is not
        loaded. A UserError if the checkpoint cannot be read or is of another kind of policy, or see
        :meth:`check_ranges`.
        """
        self.check_ranges(run, env_cfg or run.env_cfg)
        env, _ = self.make_env(run.task, options, env_cfg or run.env_cfg)
        runner, _ = self.make_alg_runner(env, run.task, train_cfg=run.train_cfg, log_root=None)
        runner.load(str(run.checkpoint), {"actor": True, "iteration": True})
        return env, runner

    def check_ranges(self, run: LoadedRun, env_cfg: Any) -> None:
        """Raise a UserError if a run's policy sees the group "critic", and its numbers mean something else."""
        if "critic" in run.train_cfg.obs_groups.actor:
            trained = _meaning_of_critic(self.get_cfgs(run.task, Options(device="cpu"), run.config)[0])
            for path, value in _meaning_of_critic(env_cfg).items():
                if value != (known := trained.get(path)):
                    needed = f"needs the training's {path}, {known}, not {value}"
                    raise UserError(f"the policy of '{run.checkpoint}' sees the group critic: it {needed}")

    def _get(self, name: str) -> tuple[type[VecEnv] | str, Any, Any]:
        """Return class and settings of a task; an unknown name is a UserError."""
        if name not in self._tasks:
            self._import_installed()
        if name not in self._tasks:
            raise UserError(f"{unknown_name('task', name, self._tasks)}; one of your own needs its --task_file")
        return self._tasks[name]

    def _import_installed(self) -> None:
        """Import the :data:`ENTRY_POINTS` of installed packages, the first time that one of their tasks may be meant.

        A broken one does not affect the others: a line on standard error says what is wrong, and its tasks are missing.
        """
        points = importlib.metadata.entry_points(group=ENTRY_POINTS) if self._looks_for_installed else ()
        self._looks_for_installed = False
        for point in points:
            if point.module not in sys.modules:
                try:
                    with self._adding(f"the entry point '{point.name} = {point.value}'"):
                        point.load()
                except UserError as error:
                    print(f"Note: {error}", file=sys.stderr)

    @contextlib.contextmanager
    def _adding(self, source: str) -> Iterator[None]:
        """Context for an import that registers tasks; after an error, the tasks are as before.

        A UserError says in which line the import fails, or that it registers none.
        """
        before = dict(self._tasks)
        try:
            yield
            if len(self._tasks) == len(before):
                raise UserError("it registers no task: it must call task_registry.register")
        except (Exception, SystemExit, GeneratorExit) as error:  # some read the command line, and end the process
            self._tasks = before
            if isinstance(error, UserError):
                raise UserError(f"{source}: {error}") from error
            last = traceback.extract_tb(error.__traceback__)[-1]
            file, line = last.filename, last.lineno
            if isinstance(error, SyntaxError):
                file, line = error.filename or "?", error.lineno
            place = f"line {line} of '{Path(file).name}'"
            raise UserError(f"{source} cannot be imported: {place}: {type(error).__name__}: {error}") from error


def _meaning_of_critic(env_cfg: Any) -> dict[str, Any]:
    """Return what orders the group "critic" and scales its random parameters, which are shares of their ranges."""
    links = ((name, getattr(env_cfg.motors, name, None)) for name in env_cfg.motors.chain)
    draws = [(f"{name}.{key}", value) for name, link in links for key, value in getattr(link, "draws", {}).items()]
    return {
        **{f"domain_rand.{name}": value for name, value in env_cfg.random_parameters().items()},
        "domain_rand.keep_fixed": sorted(env_cfg.domain_rand.keep_fixed),
        "draws of motors.chain": draws,
        "terrain.measure_heights": env_cfg.terrain.measure_heights,
    }


def print_notes(notes: Iterable[str]) -> None:
    """Print notes for the user, once for all processes, and nothing for those that are empty."""
    for note in filter(None, notes) if distributed.rank() == 0 else ():
        print(f"Note: {printable(note)}", flush=True)


def experiment_dir(train_cfg: Any, log_root: str | None = None) -> Path:
    """Return the folder that holds the runs of an experiment; the default of ``log_root`` is :data:`LOGS`."""
    return Path(log_root or LOGS) / train_cfg.runner.experiment_name


def find_teachers(train_cfg: Any, log_root: str | None = None) -> list[Path]:
    """Return the checkpoints of a student's teachers, which are given by files, or by runs of its experiment."""
    root = experiment_dir(train_cfg, log_root)
    return [runs.find_checkpoint_of(root, name).resolve() for name in train_cfg.distillation.teachers]


def num_iterations(env: VecEnv, train_cfg: Any, done: int = 0) -> int:
    """Return how many iterations a training takes from ``done`` steps on, with the steps of all processes counted."""
    steps_per_iteration = distributed.world_size() * env.num_envs * train_cfg.runner.num_steps_per_env
    return math.ceil(max(train_cfg.runner.total_steps - done, 0) / steps_per_iteration)


def set_seed(seed: int) -> None:
    """Seed every random number that a training draws; each process has random numbers of its own."""
    import torch

    torch.manual_seed(seed + 1_000_000 * distributed.rank())  # the next seed has other numbers in every process


task_registry = TaskRegistry()  # the registry that scripts use; legged_torque.envs fills it
