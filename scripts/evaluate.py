"""Measure a checkpoint: ``python scripts/evaluate.py --task=a1_position --perturbation=high``."""

from __future__ import annotations

from legged_torque.utils.interrupt import end_on_interrupt
from legged_torque.utils.rendering import without_renderer

end_on_interrupt()
without_renderer()  # before anything imports mujoco

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from legged_torque.envs import task_registry
from legged_torque.utils.args import Parser, add_task_args, options_of
from legged_torque.utils.cli import add_command_arg, check_at_least, check_output, importing, run_script, write_json
from legged_torque.utils.devices import device_name
from legged_torque.utils.metrics import UNITS
from legged_torque.utils.paths import portable_path
from legged_torque.utils.runs import package_versions
from legged_torque.utils.task_registry import set_seed

if TYPE_CHECKING:
    from legged_torque.envs.base.metrics import CommandBreakdown


def main() -> None:
    """Roll out a checkpoint with mean actions, print the metrics, write them as JSON."""
    parser = Parser(__doc__)
    add_task_args(parser)
    parser.set_defaults(num_envs=16, seed=1)
    parser.add_argument("--steps", type=int, default=2000, help="control steps; default: %(default)s")
    add_command_arg(parser)
    parser.add_argument("--json", type=Path, help="file to write")
    args = parser.parse_args()
    check_at_least(args, 1, "steps")
    if args.json:
        check_output(args.json)
    options = options_of(args)
    with importing():
        run = task_registry.load_run(options)
        import torch

        from legged_torque.envs.base.metrics import COMMANDS, CommandBreakdown, measure
        from legged_torque.learning.evaluator import evaluation_cfg
    env_cfg = evaluation_cfg(run.env_cfg, run.env_cfg.env.num_envs)
    for name, value in zip(COMMANDS, args.command or (), strict=False):
        setattr(env_cfg.commands.ranges, name, [value, value])
    set_seed(args.seed)
    env, runner = task_registry.make_loaded(run, options, env_cfg)
    breakdown = CommandBreakdown(env)
    torch.manual_seed(args.seed)  # building and loading have drawn numbers too
    metrics = measure(env, runner.get_inference_policy(env.device), args.steps, breakdown.add_step)
    trained = runner.logger.tot_timesteps
    print(f"{run.checkpoint}, after {trained:,} steps of training, {env.num_envs} worlds x {args.steps} steps:")
    for name, estimate in metrics.estimates().items():
        print(f"  {name:<18} {estimate.mean:10.4f} +- {estimate.standard_error:.4f} {UNITS[name]}")
    print_breakdown(breakdown)
    if args.json:
        kept = "as in training"
        result = {
            "task": args.task,
            "run": portable_path(run.folder),
            "checkpoint": run.checkpoint.name,
            "steps": trained,
        }
        result |= {"perturbation": args.perturbation or kept, "ranges": args.ranges or kept, "command": args.command}
        result |= {"num_envs": env.num_envs, "num_steps": args.steps, "seed": args.seed}
        result |= {"device": device_name(env.device), "versions": package_versions()}
        result["metrics"] = {name: asdict(estimate) for name, estimate in metrics.estimates().items()}
        result["by_command"] = breakdown.table()
        write_json(args.json, result)


def print_breakdown(breakdown: CommandBreakdown) -> None:
    """Print a line per part of each command's range."""
    print(f"  {'command':<12} {'from':>6} {'to':>6} {'share':>6} {'tracking':>9} {'error':>7}")
    for name, parts in breakdown.table().items():
        for part in parts:
            line = "  {:<12} {from:>6.2f} {to:>6.2f} {share:>6.2f} {track_percentage:>9.3f} {error:>7.3f}"
            print(line.format(name, **part))


if __name__ == "__main__":
    run_script(main)
