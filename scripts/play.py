"""Watch a trained policy walk: ``python scripts/play.py --task=a1_torque_multihead``, live with ``--viewer web``."""

from __future__ import annotations

from legged_torque.utils.interrupt import end_on_interrupt
from legged_torque.utils.rendering import choose_offscreen_renderer

end_on_interrupt()
NO_RENDERER = choose_offscreen_renderer()  # before anything imports mujoco

import argparse
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from legged_torque import resource_path
from legged_torque.envs import task_registry
from legged_torque.terrain.selection import named_kinds, rising_levels, select_tiles
from legged_torque.utils.args import add_task_args, options_of
from legged_torque.utils.cli import Parser, check_at_least, check_output, finite, importing, run_script
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.errors import UserError
from legged_torque.utils.metrics import UNITS
from legged_torque.utils.options import Options
from legged_torque.utils.runs import load_config
from legged_torque.utils.task_registry import LoadedRun, set_seed

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot
    from legged_torque.learning.runner import OnPolicyRunner
    from legged_torque.viewer.session import Session

NUM_ENVS = {"none": 16, "web": 4, "native": 1}  # default number of worlds, by viewer
MAX_GRID = 25  # maximum number of tiles; more would be unreadable


def main() -> None:
    """Load a run; roll it out or show it live."""
    parser = Parser(__doc__)
    add_task_args(parser)
    parser.set_defaults(seed=1)
    hint = "control steps, 50 of them a second; default: %(default)s"
    parser.add_argument("--steps", type=int, default=500, help=hint)
    parser.add_argument("--video", type=Path, help="mp4 to write; default: in the run's folder")
    parser.add_argument("--grid", type=int, help="number of robots in the video: 1, 4, 9, 16 or 25; default: 1")
    add_terrain_args(parser)
    hint = """none: roll out, print metrics, save a video; web: a page to watch and steer the robots; native: MuJoCo's
        window; default: %(default)s"""
    parser.add_argument("--viewer", choices=NUM_ENVS, default="none", help=hint)
    hint = "address of the page; default: %(default)s, this machine alone; others need the printed token"
    hint = "folder of a run whose policy walks beside the followed robot, under the same command (--viewer web)"
    parser.add_argument("--compare", metavar="RUN", help=hint)
    parser.add_argument("--host", default="127.0.0.1", help=hint)
    parser.add_argument("--port", type=int, default=8080, help="port of the page, or the next free one; default: 8080")
    args = parser.parse_args()
    check_at_least(args, 1, "steps")
    if not 1 <= args.port <= 65535:
        raise UserError(f"--port must be from 1 to 65535, not {args.port}")
    choose_worlds(args)
    kinds, levels = named_kinds(args.terrain), rising_levels(args.level)
    if levels and not kinds:
        raise UserError("--level needs --terrain: the kinds of rough ground")
    if args.video:
        check_output(args.video)
    options = options_of(args)
    with importing():
        run = task_registry.load_run(options)
        from legged_torque.viewer.session import Session
    run.env_cfg.terrain.curriculum = False  # robots stay on their tiles
    if kinds:
        select_tiles(run.env_cfg.terrain, kinds, levels, 1)
    compared = load_compared(args, run) if args.compare else None
    set_seed(args.seed)
    if args.viewer == "none":
        roll_out(args, *task_registry.make_loaded(run, options), run.checkpoint)
    else:
        watch = import_viewer(args)  # whatever is missing is reported before anything slow is done
        session = Session(task_registry.get_task_class(args.task), run, resolve_device(args.device))
        session.follow_newest(args.checkpoint is None)
        if compared:
            session.companion = Session(
                task_registry.get_task_class(compared.config["task"]), compared, resolve_device(args.device)
            )
        watch(session, resource_path(run.env_cfg.asset.file))


def load_compared(args: argparse.Namespace, run: LoadedRun) -> LoadedRun:
    """Return the run of ``--compare``; a UserError if its robot cannot walk beside that of another run."""
    if args.viewer != "web":
        raise UserError("--compare needs --viewer web")
    task = load_config(Path(args.compare))["task"]
    options = Options(task, args.device, num_envs=1, load_run=args.compare, perturbation=args.perturbation)
    compared = task_registry.load_run(options)
    if compared.env_cfg.asset.file != run.env_cfg.asset.file:
        raise UserError(
            f"--compare needs runs of one robot, not {run.env_cfg.asset.file} and {compared.env_cfg.asset.file}"
        )
    if {run.env_cfg.terrain.mesh_type, compared.env_cfg.terrain.mesh_type} != {"plane"}:
        raise UserError("--compare needs level ground; see --set terrain.mesh_type=plane")
    return compared


def choose_worlds(args: argparse.Namespace) -> None:
    """Choose how many worlds there are and how many of them are drawn; a UserError if that many cannot be."""
    if args.grid is not None and args.viewer != "none":
        raise UserError(f"--grid is for videos, which --viewer {args.viewer} does not make")
    args.grid = 1 if args.grid is None else args.grid
    if not 1 <= args.grid <= MAX_GRID or math.isqrt(args.grid) ** 2 != args.grid:
        raise UserError(f"--grid must be 1, 4, 9, 16 or {MAX_GRID}, not {args.grid}")
    if args.num_envs is None:
        args.num_envs = 1 if args.compare else max(NUM_ENVS[args.viewer], args.grid)
    elif 1 <= args.num_envs < args.grid:
        raise UserError(f"--grid {args.grid} needs as many worlds, but --num_envs is {args.num_envs}")


def add_terrain_args(parser: Parser) -> None:
    """Add what chooses the ground."""
    hint = "kinds of rough ground, or all: a column of tiles of each; default: the ground of the training"
    parser.add_argument("--terrain", nargs="+", metavar="KIND", default=[], help=hint)
    hint = "difficulties of rough ground, 0 to 1: a row of tiles of each; default: those of the training"
    parser.add_argument("--level", nargs="+", type=finite, default=[], help=hint)


def import_viewer(args: argparse.Namespace) -> Callable[[Session, Path], None]:
    """Return the function that shows a session of a robot's MJCF; a UserError if a package or a screen is missing."""
    if args.viewer == "native":
        from legged_torque.viewer import native

        native.check_display("--viewer web")
        return native.watch
    try:
        from legged_torque.viewer.web import watch
    except ImportError as error:
        raise UserError(f"--viewer web needs the extra: pip install -e .[viewer] ({error})") from None
    return functools.partial(watch, title=args.task, host=args.host, port=args.port, no_renderer=NO_RENDERER)


def roll_out(args: argparse.Namespace, env: LeggedRobot, runner: OnPolicyRunner, checkpoint: Path) -> None:
    """Roll out mean actions, print the metrics, save a video."""
    from legged_torque.envs.base.metrics import measure
    from legged_torque.viewer.video import TaskRecorder, show_in_tensorboard

    recorder = TaskRecorder(env, args.grid)
    metrics = measure(env, runner.get_inference_policy(env.device), args.steps, lambda commands: recorder.add_step())
    print(f"{checkpoint}, after {int(runner.logger.tot_timesteps):,} steps of training:")
    for name, value in metrics.means().items():
        print(f"  {name:<18} {value:8.4f} {UNITS[name]}")
    in_run = checkpoint.parent / "videos" / f"{checkpoint.stem}.mp4"
    if recorder.save(args.video or in_run, NO_RENDERER) and not args.video:
        show_in_tensorboard(in_run, runner.current_learning_iteration)


if __name__ == "__main__":
    run_script(main)
