"""Train a policy.

Examples:
    python scripts/train.py                                           # the default training: 110 million steps
    python scripts/train.py --task=a1_torque --max_iterations 20      # a short one of another task
    python scripts/train.py --task=a1_position --perturbation low --set rewards.scales.torques=-1e-4
    python scripts/train.py --resume --max_iterations 40              # go on with the last run
    python scripts/train.py --task=my_task --task_file my_task.py     # a task of your own
    python scripts/train.py --list go2                                # tasks of the Go2

On several GPUs of a machine: ``torchrun --standalone --nproc_per_node=2 scripts/train.py --task=a1_torque_multihead``;
on several machines: docs/howto/cluster.md.
"""

from __future__ import annotations

import contextlib
import functools
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legged_torque.envs import task_registry
from legged_torque.envs.tasks import list_tasks
from legged_torque.motors.model_config import ASSUMED_VOLTAGE
from legged_torque.utils import cli, distributed
from legged_torque.utils.config import Section, flat, section_keys, to_dict
from legged_torque.utils.devices import device_name, resolve_device
from legged_torque.utils.errors import TrainingError, UserError, counted
from legged_torque.utils.limits import Number
from legged_torque.utils.options import CPU_PRESET, DEFAULT_PRESET, DEFAULT_TASK, Options, without_effect
from legged_torque.utils.runs import CONFIG_FILE, given_iterations, new_run_dir, package_versions
from legged_torque.utils.stopwatch import stopwatch
from legged_torque.utils.task_registry import experiment_dir, find_teachers, num_iterations, print_notes, set_seed
from legged_torque.viewer.training_viewer import TrainingViewer

if TYPE_CHECKING:
    from legged_torque.learning.runner import OnPolicyRunner

LONG_ON_CPU = 50_000_000  # steps, which take hours with the networks of other presets than laptop


def main() -> None:
    """Parse the command line and train."""
    parser = cli.Parser(__doc__)
    cli.add_options(parser, *cli.TRAINING)
    cli.add_task_args(parser)
    hint = "print all tasks, or those with this in their names, and exit"
    parser.add_argument("--list", nargs="?", const="", metavar="PART", help=hint)
    hint = "web: a page on which the newest policy of the training walks; default: %(default)s"
    parser.add_argument("--viewer", choices=("none", "web"), default="none", help=hint)
    hint = "iterations from one short video of the policy to the next, made during the training; default: no videos"
    parser.add_argument("--video_interval", type=int, default=0, metavar="N", help=hint)
    hint = "print at the end where the seconds went, from the start of the process on"
    parser.add_argument("--timing", action="store_true", help=hint)
    args = parser.parse_args()
    cli.check_args(args, video_interval=Number)
    options, is_first = cli.options_of(args), distributed.rank() == 0
    if args.list is not None:
        print("\n".join(list_tasks(args.list)))
        return
    if options.policy:
        raise UserError("--policy is for play.py, evaluate.py and export.py: its checkpoint holds the actor alone")
    if options.resume:
        if options.preset:
            raise UserError("--preset cannot be given with --resume, which keeps the settings of the run")
        with cli.slow_imports():
            if distributed.world_size() > 1:
                from legged_torque.learning.first_run import use_first_run

                use_first_run(options)
            run = task_registry.load_run(options)
        env_cfg, train_cfg, options.task = run.env_cfg, run.train_cfg, run.task
        if train_cfg.seed != (kept_seed := run.config["train"].get("seed", train_cfg.seed)):
            raise UserError(f"the seed of a resumed run, which goes on with its random numbers, stays {kept_seed}")
        train_cfg.distillation.teachers = list(map(str, find_teachers(train_cfg, options.log_root)))
        options.load_run, options.preset = str(run.folder), run.config.get("preset")
        options.max_iterations = options.max_iterations or given_iterations(run.config)
        kept = run.config.get("processes")  # from a file
        processes = min(max(kept, 1), distributed.MAX_PROCESSES) if isinstance(kept, int) else 1
        if is_first:
            print(f"Resuming from {run.checkpoint}, after {counted(run.iterations, 'iteration')}.")
    elif options.load_run or options.checkpoint is not None:
        raise UserError("--load_run and --checkpoint need --resume")
    else:
        options.task = options.task or DEFAULT_TASK
        with cli.slow_imports():
            env_cfg, train_cfg = new_settings(options)
        processes = min(distributed.usable_cores(), distributed.MAX_PROCESSES)
    on_cores = options.preset == CPU_PRESET and resolve_device(options.device) == "cpu" and learns_in_parts(train_cfg)
    if on_cores and distributed.use_cores(processes) and options.resume:
        from legged_torque.learning.first_run import use_first_run

        use_first_run(options)  # as the others do
    folder = experiment_dir(train_cfg, options.log_root)
    if is_first:  # the others write nothing
        cli.check_output(new_run_dir(folder, train_cfg.runner.run_name) / CONFIG_FILE)
    with cli.slow_imports():
        from legged_torque.utils.progress import CompileProgress
    viewer = TrainingViewer(is_first and args.viewer == "web", args.video_interval if is_first else 0)
    set_seed(train_cfg.seed)
    stopwatch.lap("imports and settings")
    try:
        with CompileProgress() if is_first else contextlib.nullcontext():  # one line for all processes
            train(options, env_cfg, train_cfg, viewer)
    finally:
        if args.timing and is_first:
            stopwatch.lap("end")
            print(f"Time: {stopwatch}")


def new_settings(options: Options) -> tuple[Any, Any]:
    """Return the settings of a task and its training; on a CPU, those of the preset for it unless another is given."""
    before = task_registry.get_new_cfgs(options)
    is_open = options.preset is None and CPU_PRESET in before[1].presets()
    if not is_open or resolve_device(options.device) != "cpu":
        return before
    options.preset = CPU_PRESET
    after = task_registry.get_new_cfgs(options)
    names = ", ".join(name for pair in zip(before, after, strict=True) for name in replaced(*pair))
    note = f"on a CPU, the preset {CPU_PRESET} replaces the task's own {names}; --preset {DEFAULT_PRESET} keeps them"
    print_notes([note if names else ""])
    return after


def replaced(before: Any, after: Any, path: str = "") -> Iterator[str]:
    """Yield the names of settings that differ from this package's and have other values afterwards."""
    kind: Any = next(cls for cls in type(before).__mro__ if cls.__module__.startswith("legged_torque."))
    ours = vars(kind())
    for key in section_keys(before):
        old, new = getattr(before, key), getattr(after, key)
        if isinstance(old, Section):
            yield from replaced(old, new, f"{path}{key}.")
        elif old not in (new, ours.get(key)) and key != "num_envs":  # which is num_envs_cpu, whatever the preset
            yield f"{path}{key}"


def draws_note(env_cfg: Any) -> str:
    """Return the note that constants of motors are not drawn although they have ranges, other than batteries have."""
    links = ((name, getattr(getattr(env_cfg.motors, name), "draws", {})) for name in env_cfg.motors.chain)
    names = ", ".join(f"motors.{name}.draws" for name, draws in links if draws not in ({}, ASSUMED_VOLTAGE))
    note = f"{names} needs domain_rand.randomize_parameters=true, which --perturbation low sets"
    return note if names and not env_cfg.domain_rand.randomize_parameters else ""


def also_note(cfg: Any, steps: int) -> str:
    """Return the note that a training of so many steps ends before ``evaluation.also`` begins; empty if it does not."""
    note = f"evaluation.also measures nothing: evaluation.also_from is {cfg.also_from:,}, but there are {steps:,} steps"
    return note if cfg.also and cfg.interval and steps < cfg.also_from else ""


def length_note(train_cfg: Any) -> str:
    """Return the note that a training takes hours on a CPU, and what takes less; empty if it is not that long."""
    shorter = f"--preset {CPU_PRESET} takes minutes, and " if CPU_PRESET in train_cfg.presets() else ""
    note = f"this training takes hours on a CPU; {shorter}Ctrl-C keeps the run"
    return note if train_cfg.runner.total_steps >= LONG_ON_CPU else ""


def learns_in_parts(train_cfg: Any) -> bool:
    """Return whether processes can train the settings' learner together."""
    from rsl_rl.utils import resolve_callable

    return hasattr(resolve_callable(train_cfg.algorithm.class_name), "broadcast_parameters")


def train(options: Options, env_cfg: Any, train_cfg: Any, viewer: TrainingViewer) -> None:
    """Build the task and train it, from a pre-trained policy if the task has one."""
    from legged_torque.deploy.export import export_note
    from legged_torque.envs.base.held_pose import standing_note
    from legged_torque.envs.base.legged_robot import LeggedRobot
    from legged_torque.learning.trainer import Trainer

    is_first = distributed.rank() == 0
    env, _ = task_registry.make_env(options.task, options, env_cfg)
    stopwatch.lap("task")
    if is_first and isinstance(env, LeggedRobot) and not options.resume:
        print_notes([standing_note(env), draws_note(env_cfg), *without_effect(env_cfg, options.set)])
    runner, _ = task_registry.make_alg_runner(env, options.task, options, train_cfg)
    if not isinstance(runner, Trainer):
        ours = "legged_torque.learning.runner:OnPolicyRunner"
        raise UserError(f"runner.class_name must name {ours} or what inherits it, not {type(runner).__name__}")
    if train_cfg.pretraining.function and not options.resume and is_first:  # from whom the others get their networks
        from legged_torque.paper.gravity.pretrained import find_pretrained, pretrained_file, start_from

        pretrained = pretrained_file(options.task, train_cfg, options.log_root)
        find_pretrained(pretrained, options.task, env_cfg, train_cfg, env.device)
        start_from(runner, pretrained)
    if is_first and isinstance(env, LeggedRobot):
        print_notes([export_note(env, runner.alg.policy())])
    runner.verbose = options.verbose
    steps = runner.logger.tot_timesteps
    before = runner.current_learning_iteration if steps else 0  # a runner of a user's own may not count steps on
    total = options.max_iterations or before + num_iterations(env, train_cfg, steps)
    settings = {"env": to_dict(env_cfg), "train": to_dict(train_cfg), "version": package_versions()}
    distributed.check_same(flat({**settings, "task": options.task, "max_iterations": total}))
    remaining = total - runner.current_learning_iteration
    if remaining < 1:
        done = runner.current_learning_iteration
        command = [*sys.argv[1:], f"--max_iterations={2 * done}"]
        further = f"{cli.script_command('train')} {shlex.join(command)}"
        raise UserError(f"the run has all of its {counted(done, 'iteration')}; to go on: {further}")
    if is_first:
        steps += remaining * distributed.world_size() * env.num_envs * train_cfg.runner.num_steps_per_env
        print_notes([also_note(train_cfg.evaluation, steps)])
        is_short = options.max_iterations or options.resume or train_cfg.distillation.teachers
        print_notes([length_note(train_cfg)] if env.device == "cpu" and not is_short else [])
        announce(runner, options, env_cfg, train_cfg, total, viewer.page)
        runner.on_checkpoint = functools.partial(viewer.show, cli.option_words(options, "task_file", "task"))
    is_complete = False
    stopwatch.lap("trainer")
    try:
        runner.learn(remaining, init_at_random_ep_len=True)
        is_complete = not runner.stopped_by
    except (TrainingError, BrokenPipeError):
        runner.close()
        raise
    finally:
        viewer.close(is_waiting=is_complete)
    if is_first:
        print(f"The run is in {runner.log_dir}")
        for what, script in {"See it walk": "play", "Measure it": "evaluate", "Take it elsewhere": "export"}.items():
            print(f"{what}: {cli.script_command(script)} {run_words(options, runner.log_dir)}")
    runner.close()
    if runner.stopped_by:
        sys.exit(128 + runner.stopped_by)  # as shells do: 130 after Ctrl-C


def announce(runner: OnPolicyRunner, options: Options, env_cfg: Any, train_cfg: Any, total: int, page: str) -> None:
    """Create the run's folder with its settings, and print where it is and how to watch it."""
    device, num_processes = runner.env.device, distributed.world_size()
    settings = {"task": options.task, "preset": options.preset or DEFAULT_PRESET, "device": device}
    settings |= {"device_name": device_name(device), "processes": num_processes, "max_iterations": total}
    settings["given_iterations"] = options.max_iterations
    runner.claim_log_dir(settings | {"env": to_dict(env_cfg), "train": to_dict(train_cfg)})
    place = device_name(device) if num_processes == 1 else f"{num_processes} x {device_name(device)}"
    worlds = counted(num_processes * runner.env.num_envs, "world")
    print(f"Training {options.task} on {place}: {worlds}, {counted(total, 'iteration')}.")
    print(f"Curves: {shlex.join(['tensorboard', '--logdir', runner.log_dir])}")
    how = page or f"{cli.script_command('play')} {run_words(options, runner.log_dir)} --viewer web"
    print(f"See it learn: {how}", flush=True)


def run_words(options: Options, run_dir: str) -> str:
    """Return the options with which other scripts find a run, short enough for a line of a terminal if they can be."""
    run, words = Path(run_dir), cli.option_words(options, "task_file", "log_root")
    is_alone = len([*run.parents[1].glob(f"*/{run.name}")]) == 1
    return shlex.join([*words, f"--load_run={run.name if is_alone else run}"])


if __name__ == "__main__":
    cli.run_script(main)
