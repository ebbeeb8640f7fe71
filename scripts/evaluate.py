"""Measure a checkpoint: ``python scripts/evaluate.py --task=a1_position --perturbation=high``."""

from legged_torque.utils.rendering import without_renderer

without_renderer()  # before anything imports mujoco

import json
import math
from dataclasses import asdict
from pathlib import Path

import torch

from legged_torque.envs import task_registry
from legged_torque.envs.base.metrics import COMMANDS, CommandBreakdown, WalkingMetrics, measure
from legged_torque.learning.evaluator import evaluation_cfg
from legged_torque.utils.args import Parser, add_task_args, options_of
from legged_torque.utils.cli import prepare_file, run_script
from legged_torque.utils.devices import device_name
from legged_torque.utils.errors import UserError
from legged_torque.utils.metrics import UNITS
from legged_torque.utils.runs import package_versions
from legged_torque.utils.task_registry import set_seed


def main() -> None:
    """Roll out a checkpoint with mean actions, print the metrics, write them as JSON."""
    parser = Parser(__doc__)
    add_task_args(parser)
    parser.set_defaults(num_envs=16, seed=1)
    parser.add_argument("--steps", type=int, default=2000, help="control steps; default: %(default)s")
    parser.add_argument(
        "--command",
        type=float,
        nargs=3,
        metavar=("X", "Y", "YAW"),
        help="fixed command [m/s, m/s, rad/s]; default: drawn as in training",
    )
    parser.add_argument("--json", type=Path, help="file to write")
    args = parser.parse_args()
    if args.steps < 1:
        raise UserError(f"--steps must be at least 1, not {args.steps}")
    if args.command and not all(map(math.isfinite, args.command)):
        raise UserError(f"--command must be finite, not {args.command}")
    options = options_of(args)
    run = task_registry.load_run(options)
    if args.json:
        prepare_file(args.json)
    env_cfg = evaluation_cfg(run.env_cfg, run.env_cfg.env.num_envs)
    for name, value in zip(COMMANDS, args.command or (), strict=False):
        setattr(env_cfg.commands.ranges, name, [value, value])
    set_seed(args.seed)
    env, runner = task_registry.make_loaded(run, options, env_cfg)
    breakdown = CommandBreakdown(env)
    torch.manual_seed(args.seed)  # building and loading have drawn numbers too
    metrics = measure(env, runner.get_inference_policy(env.device), args.steps, breakdown.add_step)
    result = {
        "task": args.task,
        "run": str(run.folder),
        "checkpoint": run.checkpoint.name,
        "steps": runner.logger.tot_timesteps,
        "perturbation": args.perturbation or "as in training",
        "ranges": args.ranges or "as in training",
        "command": args.command,
        "num_envs": env.num_envs,
        "num_steps": args.steps,
        "seed": args.seed,
        "device": device_name(env.device),
        "versions": package_versions(),
    }
    print(f"{run.checkpoint}, after {result['steps']:,} steps of training, {env.num_envs} worlds x {args.steps} steps:")
    print_metrics(metrics)
    print_breakdown(breakdown)
    if args.json:
        result["metrics"] = {name: asdict(estimate) for name, estimate in metrics.estimates().items()}
        result["by_command"] = breakdown.table()
        args.json.write_text(json.dumps(without_nan(result), indent=1) + "\n", encoding="utf-8")


def print_metrics(metrics: WalkingMetrics) -> None:
    """Print a line per metric."""
    for name, estimate in metrics.estimates().items():
        print(f"  {name:<18} {estimate.mean:10.4f} +- {estimate.standard_error:.4f} {UNITS[name]}")


def print_breakdown(breakdown: CommandBreakdown) -> None:
    """Print a line per part of each command's range."""
    print(f"  {'command':<12} {'from':>6} {'to':>6} {'share':>6} {'tracking':>9} {'error':>7}")
    for name, parts in breakdown.table().items():
        for part in parts:
            print(
                f"  {name:<12} {part['from']:>6.2f} {part['to']:>6.2f} {part['share']:>6.2f} "
                f"{part['track_percentage']:>9.3f} {part['error']:>7.3f}"
            )


def without_nan(value):
    """Return a value with null in place of what is not a number, which JSON does not know."""
    if isinstance(value, dict):
        return {key: without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [without_nan(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    run_script(main)
