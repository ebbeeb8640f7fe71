"""Watch a policy walk.

Examples:
    python scripts/play.py                                  # the last run: print metrics, save a video
    python scripts/play.py --viewer web                     # a page to watch and steer
    python scripts/play.py --load_run RUN --command 0.5 0 0.2
    python scripts/play.py --no_video                       # metrics alone
    python scripts/play.py --task=a1_torque --agent random  # a task without a policy
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import os
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from legged_torque import SCRIPTS_DIR
from legged_torque.deploy.description import place_of_results
from legged_torque.envs import task_registry
from legged_torque.terrain.selection import named_kinds, rising_levels, select_tiles
from legged_torque.utils import cli
from legged_torque.utils.devices import choose_offscreen_renderer, resolve_device
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import path_inside
from legged_torque.utils.limits import Count, Limits
from legged_torque.utils.metrics import UNITS, hide_nan
from legged_torque.utils.options import DEFAULT_TASK, without_effect
from legged_torque.utils.task_registry import LOGS, LoadedRun, experiment_dir, print_notes, set_seed
from legged_torque.viewer.training_viewer import HOST, PORT

if TYPE_CHECKING:
    from tensordict import TensorDict
    from torch import Tensor

    from legged_torque.envs.base.legged_robot import LeggedRobot
    from legged_torque.viewer.session import Session

AGENTS = ("zero", "random")  # what acts without a policy
NUM_ENVS = {"none": 16, "web": 4, "native": 1}  # default number of worlds, by viewer
STEPS = 500  # control steps of a roll-out
GRIDS = (1, 4, 9, 16, 25)  # numbers of tiles of a video; more would be unreadable


def main() -> None:
    """Roll a policy out or show it live; without a policy, roll out zero or random actions."""
    args = parse_args()
    args.no_renderer = choose_offscreen_renderer()
    kinds, levels = named_kinds(args.terrain), rising_levels(args.level)
    options = cli.options_of(args)
    if args.agent != "policy":
        options.task = options.task or DEFAULT_TASK
    with cli.slow_imports():
        run = task_registry.load_run(options) if args.agent == "policy" else None
        env_cfg, train_cfg = (run.env_cfg, run.train_cfg) if run else task_registry.get_cfgs(options.task, options)
    if args.grid > env_cfg.env.num_envs:
        raise UserError(f"--grid {args.grid} needs as many worlds, not {env_cfg.env.num_envs}")
    env_cfg.terrain.curriculum = env_cfg.commands.curriculum = False  # all tiles, all commands
    if kinds:
        select_tiles(env_cfg.terrain, kinds, levels, 1)
    print_notes(without_effect(env_cfg, options.set))
    set_seed(args.seed)
    if run and args.viewer != "none":
        show(args, run)
        return
    if args.command:
        env_cfg.commands.fix(args.command)
    if run:
        from legged_torque.viewer.video import show_in_tensorboard

        env, runner = task_registry.make_loaded(run, options)
        title = f"{run.checkpoint}, after {int(runner.logger.tot_timesteps):,} steps of training"
        place = place_of_results(run.checkpoint.parent, options.policy, options.log_root or LOGS)
        video = path_inside(place, f"videos/{run.checkpoint.stem}.mp4")
        if roll_out(args, env, runner.get_inference_policy(env.device), title, video):
            show_in_tensorboard(video, run.iterations)
    else:
        env, _ = task_registry.make_env(options.task, options, env_cfg)
        video = experiment_dir(train_cfg, options.log_root) / "videos" / f"{args.agent}.mp4"
        roll_out(args, env, agent(args.agent, env), f"{args.agent} actions", video)


def parse_args() -> argparse.Namespace:
    """Return the command line; a UserError if it makes no sense."""
    parser = cli.Parser(__doc__)
    cli.add_task_args(parser)
    parser.set_defaults(seed=1)
    parser.add_argument("--steps", type=int, help=f"control steps, of most tasks 50 a second; default: {STEPS}")
    hint = "who acts: the run's policy, or zero or random actions (from -1 to 1) without a run; default: %(default)s"
    parser.add_argument("--agent", choices=("policy", *AGENTS), default="policy", help=hint)
    cli.add_command_arg(parser)
    hint = "kinds of rough ground, or all: a column of tiles of each; default: the ground of the training"
    parser.add_argument("--terrain", nargs="+", metavar="KIND", default=[], help=hint)
    hint = "difficulties of rough ground, 0 to 1: a row of tiles of each; default: those of the training"
    parser.add_argument("--level", nargs="+", type=float, default=[], help=hint)
    parser.add_argument("--video", type=cli.video_file, help="mp4 or gif to write; default: in the run's folder")
    parser.add_argument("--no_video", action="store_true", help="print metrics alone")
    parser.add_argument("--grid", type=int, help="number of robots in the video: 1, 4, 9, 16 or 25; default: 1")
    hint = """none: roll out, print metrics, save a video; web: a page to watch and steer the robots; native: MuJoCo's
        window; default: %(default)s"""
    parser.add_argument("--viewer", choices=NUM_ENVS, default="none", help=hint)
    hint = "run whose policy walks next to the followed robot, under the same command (--viewer web): a name or a path"
    parser.add_argument("--compare", metavar="RUN", help=hint)
    hint = f"address of the page; default: {HOST}, this machine alone; others need the printed token"
    parser.add_argument("--host", help=hint)
    parser.add_argument("--port", type=int, help=f"port of the page, or the next free one; default: {PORT}")
    args = parser.parse_args()
    cli.check_args(args, steps=Count, command=list[float], port=Annotated[int, Limits(1, 65535)])
    check_combinations(args)
    args.grid, args.steps = args.grid or 1, args.steps or STEPS
    args.host, args.port = args.host or HOST, args.port or PORT
    if args.num_envs is None:
        args.num_envs = 1 if args.compare else max(NUM_ENVS[args.viewer], args.grid)
    if args.video:
        cli.check_output(args.video)
    return args


def check_combinations(args: argparse.Namespace) -> None:
    """Raise a UserError for options that exclude each other."""
    has_viewer = args.viewer != "none"
    if args.grid not in (None, *GRIDS):
        raise UserError(f"--grid must be 1, 4, 9, 16 or 25, not {args.grid}")
    for option in ("grid", "video", "steps"):
        if getattr(args, option) and has_viewer:
            raise UserError(f"--{option} is not for --viewer {args.viewer}, which shows robots live")
    if args.agent != "policy" and (args.load_run or args.policy or args.checkpoint is not None or has_viewer):
        others = "--load_run, --policy, --checkpoint and --viewer"
        raise UserError(f"--agent {args.agent} has no run: {others} are for policies")
    if args.headless and args.viewer == "native":
        raise UserError("--headless opens no window, but --viewer native is one; --viewer web is a page")
    for option in ("compare", "host", "port"):
        if getattr(args, option) and args.viewer != "web":
            raise UserError(f"--{option} needs --viewer web")
    if args.no_video and (args.video or (args.grid or 1) > 1 or has_viewer):
        raise UserError("--no_video prints metrics alone: leave out --video, --grid and --viewer")
    if args.level and not args.terrain:
        raise UserError("--level needs --terrain: the kinds of rough ground")


def show(args: argparse.Namespace, run: LoadedRun) -> None:
    """Show a policy live, and one that it is compared with."""
    compared = load_compared(args, run) if args.compare else None
    watch, device = import_viewer(args, run.task), resolve_device(args.device)  # refuse before slow imports
    with cli.slow_imports():
        from legged_torque.viewer.session import Session
    session = Session(task_registry.get_task_class(run.task), run, device)
    session.follow_newest(args.checkpoint in (None, -1))
    if compared:
        session.companion = Session(task_registry.get_task_class(compared.task), compared, device)
    if args.command:
        session.set_command(tuple(args.command))
    port = watch(session)
    if session.chosen:
        demo = [str(SCRIPTS_DIR / "demo.py"), session.chosen, f"--host={args.host}", f"--port={port}"]
        os.execv(sys.executable, [sys.executable, *demo, *cli.option_words(args, "device")])


def load_compared(args: argparse.Namespace, run: LoadedRun) -> LoadedRun:
    """Return the run of ``--compare``; a UserError if its robot cannot walk next to that of another run."""
    options = dataclasses.replace(cli.options_of(args), task="", num_envs=1, load_run=args.compare)
    options.policy = options.checkpoint = options.experiment_name = None
    compared = task_registry.load_run(options)
    robots = [cfg.asset.file for cfg in (run.env_cfg, compared.env_cfg)]
    if robots[0] != robots[1]:
        raise UserError("--compare needs runs of one robot, not {} and {}".format(*robots))
    rates = [1.0 / (cfg.sim.dt * cfg.control.decimation) for cfg in (run.env_cfg, compared.env_cfg)]
    if not math.isclose(*rates):
        raise UserError("--compare needs runs of one rate, not {:g} and {:g} Hz; see --policy_hz".format(*rates))
    if {run.env_cfg.terrain.mesh_type, compared.env_cfg.terrain.mesh_type} != {"plane"}:
        raise UserError("--compare needs level ground; see --set terrain.mesh_type=plane")
    return compared


def agent(name: str, env: LeggedRobot) -> Callable[[TensorDict], Tensor]:
    """Return what acts without a policy: zero actions, or random ones, drawn uniformly from -1 to 1."""
    import torch

    actions = torch.zeros(env.num_envs, env.num_actions, device=env.device)
    return lambda obs: actions.uniform_(-1.0, 1.0) if name == "random" else actions


def import_viewer(args: argparse.Namespace, title: str) -> Callable[[Session], int | None]:
    """Return what shows a session and returns a page's port; a UserError if a package or a screen is missing."""
    if args.viewer == "native":
        from legged_torque.viewer import native

        native.check_display("--viewer web")
        return native.watch
    try:
        from legged_torque.viewer.web import watch
    except ImportError as error:
        raise UserError(f"--viewer web needs the extra: pip install 'legged_torque[viewer]' ({error})") from None
    again = f"{cli.script_command('play')} {shlex.join(sys.argv[1:])}"
    words = {"title": title, "host": args.host, "port": args.port, "again": again, "no_renderer": args.no_renderer}
    return functools.partial(watch, **words)


def roll_out(
    args: argparse.Namespace, env: LeggedRobot, policy: Callable[[TensorDict], Tensor], title: str, video: Path
) -> bool:
    """Roll actions out, print the metrics, save a video, by default to the file ``video``; return if that is there."""
    from legged_torque.envs.base.metrics import measure
    from legged_torque.viewer.video import TaskRecorder

    recorder = None if args.no_video else TaskRecorder(env, args.grid)
    metrics = measure(env, policy, args.steps, lambda commands: recorder.add_step() if recorder else None)
    print(f"{title}:")
    for name, value in metrics.means().items():
        print(hide_nan(f"  {name:<18} {value:8.4f} {UNITS[name]}"))
    return recorder is not None and recorder.save(args.video or video, args.no_renderer) and not args.video


if __name__ == "__main__":
    cli.run_script(main, draws=True)
