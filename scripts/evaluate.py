"""Measure a checkpoint.

Examples:
    python scripts/evaluate.py                                          # the last run, as in its training
    python scripts/evaluate.py --task=a1_position --perturbation=high   # in another environment
    python scripts/evaluate.py --load_run RUN --command 0.5 0 0.2       # with one command
    python scripts/evaluate.py --terrain all --level 0.5                # on rough ground
    python scripts/evaluate.py --sweep ground_friction                  # by the value of a random parameter

With ``--terrain`` and ``--level``, robots try to cross tiles of rough ground, once in each world: see docs/terrain.md.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legged_torque.envs import task_registry
from legged_torque.experiments.matrix import GROUNDS
from legged_torque.utils import cli
from legged_torque.utils.devices import device_name
from legged_torque.utils.errors import UserError, counted
from legged_torque.utils.files import portable_path, without_machine, write_json
from legged_torque.utils.limits import Count
from legged_torque.utils.metrics import UNITS, hide_nan
from legged_torque.utils.options import PUSH, draw_only, without_effect
from legged_torque.utils.runs import package_versions
from legged_torque.utils.task_registry import LoadedRun, print_notes, set_seed

if TYPE_CHECKING:
    from rsl_rl.runners import OnPolicyRunner

    from legged_torque.envs.base.crossing import Grounds
    from legged_torque.envs.base.legged_robot import LeggedRobot

WORLDS, STEPS = 16, 2000  # of one checkpoint


def main() -> None:
    """Roll out a checkpoint with mean actions, print the metrics, write them as JSON."""
    args = parse_args()
    options = cli.options_of(args)
    grounds = None
    with cli.slow_imports():
        if args.terrain:
            from legged_torque.envs.base.crossing import Grounds

            grounds = Grounds.of(args.terrain, args.level, args.command)
        run = task_registry.load_run(options)
        if args.json:
            cli.check_output(args.json)
        args.seed = 1 if args.seed is None else args.seed
        import torch

        from legged_torque.envs.base.evaluation import evaluation_cfg
    if grounds:
        env_cfg = grounds.cfg(run.env_cfg, run.env_cfg.env.num_envs)
    else:
        env_cfg = evaluation_cfg(run.env_cfg, run.env_cfg.env.num_envs)
        if args.command:
            env_cfg.commands.fix(args.command)
        if args.sweep:
            draw_only(env_cfg, args.sweep)
    set_seed(args.seed)
    env, runner = task_registry.make_loaded(run, options, env_cfg)
    print_notes(without_effect(env_cfg, options.set if args.sweep != PUSH else []))  # it pushes without the switch
    torch.manual_seed(args.seed)  # building and loading have drawn numbers too
    if args.sweep:
        measured = sweep(args, run, env, runner)
    elif grounds:
        measured = cross_tiles(run, env, runner, grounds)
    else:
        measured = walk(run, env, runner, args.steps, bool(args.command))
    if args.json:
        kept, device = "as in training", device_name(env.device)
        result = {"task": run.task, "run": portable_path(run.folder), "checkpoint": run.checkpoint.name}
        result |= {"steps": runner.logger.tot_timesteps, "perturbation": args.perturbation or kept}
        result |= {"ranges": args.ranges or kept, "motors": args.motors or kept, "set": args.set}
        command = args.command or (grounds and [*grounds.command, 0.0])
        result |= {"command": command, "num_envs": env.num_envs, "seed": args.seed}
        result |= {"device": device, "versions": package_versions()}
        result |= {name: rate for name in cli.CLOCKS if (rate := getattr(args, name))}
        write_json(args.json, without_machine(result | measured))


def parse_args() -> argparse.Namespace:
    """Return the command line; a UserError if it makes no sense."""
    parser = cli.Parser(__doc__)
    cli.add_task_args(parser)
    parser.add_argument("--steps", type=int, help=f"control steps; default: {STEPS}")
    cli.add_command_arg(parser)
    hint = """kinds of rough ground to cross, or all; then --num_envs is for each kind and level, and --command a speed
        straight on, 0.6 0 0 unless it is given"""
    parser.add_argument("--terrain", nargs="+", metavar="KIND", help=hint)
    hint = "difficulties of rough ground, 0 to 1; default: the ten of training, 0 to 0.9"
    parser.add_argument("--level", nargs="+", type=float, help=hint)
    hint = "random parameter, whose range is split: prints metrics of each part, see docs/results.md"
    parser.add_argument("--sweep", metavar="NAME", help=hint)
    parser.add_argument("--json", type=Path, help="file to write")
    args = parser.parse_args()
    if args.sweep and args.terrain:
        raise UserError("--sweep does not take --terrain")
    if args.terrain and args.steps is not None:
        raise UserError("--steps is not for --terrain: how long robots may try follows from the command")
    if args.level and not args.terrain:
        raise UserError("--level needs --terrain: the kinds of rough ground")
    args.num_envs = WORLDS if args.num_envs is None else args.num_envs
    args.steps = STEPS if args.steps is None else args.steps
    args.level = args.level or GROUNDS["levels"]
    cli.check_args(args, steps=Count, command=list[float])
    return args


def walk(run: LoadedRun, env: LeggedRobot, runner: OnPolicyRunner, num_steps: int, is_fixed: bool) -> dict[str, Any]:
    """Roll a policy out, print its metrics, and return them; a fixed command has no parts of its range to compare."""
    from legged_torque.envs.base.metrics import CommandBreakdown, measure

    breakdown = CommandBreakdown(env)
    metrics = measure(env, runner.get_inference_policy(env.device), num_steps, breakdown.add_step).estimates()
    trained = runner.logger.tot_timesteps
    size = f"{counted(env.num_envs, 'world')} x {counted(num_steps, 'step')}"
    print(f"{run.checkpoint}, after {counted(trained, 'step')} of training, {size}:")
    for name, estimate in metrics.items():
        print(hide_nan(f"  {name:<18} {estimate.mean:10.4f} +- {estimate.standard_error:.4f} {UNITS[name]}"))
    if not is_fixed:
        print(f"  {'command':<19} {'from':>6} {'to':>6} {'share':>6} {'tracking [share]':>16} {'error':>16}")
    line = "  {:<19} {from:>6.2f} {to:>6.2f} {share:>6.2f} "
    line += "{track_percentage:7.3f} +- {track_percentage_standard_error:.3f} "
    line = "  error of {:<19} " if is_fixed else line
    for name, parts in breakdown.table().items():
        what = f"{name} [{'rad/s' if name == 'ang_vel_yaw' else 'm/s'}]"
        for part in parts:
            print(hide_nan((line + "{error:7.3f} +- {error_standard_error:.3f}").format(what, **part)))
    shown = {name: asdict(estimate) for name, estimate in metrics.items()}
    return {"num_steps": num_steps, "metrics": shown, "by_command": breakdown.table()}


def sweep(args: argparse.Namespace, run: LoadedRun, env: LeggedRobot, runner: OnPolicyRunner) -> dict[str, Any]:
    """Roll a policy out, print its metrics for each part of a parameter's range, and return them."""
    from legged_torque.envs.base.metrics import measure
    from legged_torque.envs.base.sweep import PushSweep, Sweep

    parts = PushSweep(env) if args.sweep == PUSH else Sweep(env, args.sweep)
    measure(env, runner.get_inference_policy(env.device), args.steps, parts.add_step)
    size = f"{counted(env.num_envs, 'world')} x {counted(args.steps, 'step')}"
    print(f"{run.checkpoint}, after {counted(runner.logger.tot_timesteps, 'step')} of training, {size}:")
    for line in parts.lines():
        print(hide_nan(line))
    return {"num_steps": args.steps, "sweep": {"parameter": parts.name, "unit": parts.unit, "parts": parts.table()}}


def cross_tiles(run: LoadedRun, env: LeggedRobot, runner: OnPolicyRunner, grounds: Grounds) -> dict[str, Any]:
    """Let a policy try to cross tiles, print what came out, and return it."""
    from legged_torque.envs.base.crossing import cross

    results = cross(env, runner.get_inference_policy(env.device), grounds)
    time_limit, trained = grounds.time_limit(env.cfg.terrain.tile_size), runner.logger.tot_timesteps
    trial = "commanded to walk {:g} {:g} m/s for {:.1f} s at most".format(*grounds.command, time_limit)
    print(f"{run.checkpoint}, after {counted(trained, 'step')} of training, {counted(env.num_envs, 'world')}, {trial}:")
    print(f"  {'kind':<18} {'level':>6} {'worlds':>6} {'crossed':>16} {'fell':>16} {'tracking':>9} {'cost':>6}")
    for result in results:
        shares = [hide_nan(f"{each.mean:.3f} +- {each.standard_error:.3f}") for each in (result.crossed, result.fell)]
        tracking, cost = (result.metrics[name].mean for name in ("track_percentage", "cost_of_transport"))
        place = f"  {result.kind:<18} {result.level:>6g} {result.worlds:>6}"
        print(f"{place} {shares[0]:>16} {shares[1]:>16} {tracking:>9.3f} {cost:>6.2f}")
    return {"time_limit": time_limit, "grounds": [asdict(result) for result in results]}


if __name__ == "__main__":
    cli.run_script(main)
