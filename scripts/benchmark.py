"""Measure the speed and the memory of training: ``python scripts/benchmark.py --num_envs 1024 4096``."""

import os

os.environ["MUJOCO_GL"] = "disable"
os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # torch's profiler otherwise tells on standard error when it starts

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

from legged_torque.checks.benchmark import TRACED, MemoryMeter, Plan, measure
from legged_torque.envs import task_registry
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.utils.args import Parser, add_settings_args, options_of
from legged_torque.utils.cli import prepare_file, run_script
from legged_torque.utils.devices import device_name, resolve_device
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import package_versions

COLUMNS = {
    "num_envs": ("worlds", 0),
    "physics_ms": ("physics ms", 2),
    "step_ms": ("step ms", 2),
    "rollout_ms": ("rollout ms", 1),
    "update_ms": ("update ms", 1),
    "log_ms": ("log ms", 1),
    "iteration_ms": ("iteration ms", 1),
    "iteration_over_physics": ("x floor", 2),
    "iteration_steps_per_s": ("steps/s", 0),
    "peak_memory_mib": ("peak MiB", 0),
    "startup_s": ("start-up s", 1),
}
"""Heading of each column and its number of decimals."""

LEGEND = """\
  physics: the physics steps of one control step alone; step: env.step; iteration: a whole one of training, with logging
  x floor: iteration / (physics x control steps of a rollout); steps/s: those of whole iterations
  peak: {memory}
  start-up: from building the task to the end of the second iteration, when all is compiled and captured"""
MEMORY = {
    "cuda": "GPU memory of torch and Warp together, without the CUDA context",
    "cpu": "resident memory of this process so far",
}


def main() -> None:
    """Measure every number of worlds and print a table."""
    args = parse_args()
    device = resolve_device(args.device)
    settings = [size_settings(args, num_envs) for num_envs in args.num_envs or [None]]
    for file in filter(None, (args.json, args.profile)):
        prepare_file(file)
    print(f"{args.task} on {device_name(device)}, medians of {args.rounds} rounds")
    print(LEGEND.format(memory=MEMORY[device.split(":")[0]]))
    print(" | ".join(f"{title:>{width(title)}}" for title, _ in COLUMNS.values()), flush=True)
    memory = MemoryMeter(device)
    result = {
        "task": args.task,
        "device": device_name(device),
        "versions": package_versions(),
        "preset": args.preset or "parallel",
        "perturbation": args.perturbation or "none",
        "ranges": args.ranges or "wide",
        "set": args.set,
        "rounds": args.rounds,
        "rows": [],
    }
    for env_cfg, train_cfg in settings:
        row = measure(args.task, env_cfg, train_cfg, Plan(args.rounds, args.endurance, args.profile), memory, device)
        memory.clear()
        result["rows"].append(row | {"left_memory_mib": memory.used()})
        print_row(row)
        if "kernels" in row:
            print_kernels(row["kernels"], device, args.profile)
        if args.json:
            args.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def parse_args() -> argparse.Namespace:
    """Return the command line.

    Raises:
        UserError: If it makes no sense.
    """
    parser = Parser(__doc__)
    add_settings_args(parser)
    parser.add_argument("--num_envs", type=int, nargs="+", help="numbers of worlds; default: that of the task")
    parser.add_argument("--preset", help="training settings: parallel (the default) or paper (Table II)")
    parser.add_argument("--rounds", type=int, default=10, help="how often each part is timed; default: %(default)s")
    parser.add_argument("--json", type=Path, help="file to write all numbers to")
    parser.add_argument(
        "--profile", type=Path, help=f"file for a trace of {TRACED} iterations, for ui.perfetto.dev; .json or .json.gz"
    )
    parser.add_argument(
        "--endurance", type=int, default=0, metavar="N", help="also run N iterations and compare their first and last"
    )
    args = parser.parse_args()
    if args.rounds < 1:
        raise UserError(f"--rounds must be at least 1, not {args.rounds}")
    if args.endurance < 0:
        raise UserError(f"--endurance must be at least 0, not {args.endurance}")
    if args.profile and len(args.num_envs or [None]) > 1:
        raise UserError("--profile writes one trace: give one number of worlds")
    return args


def size_settings(args: argparse.Namespace, num_envs: int | None) -> tuple[Any, Any]:
    """Return the settings of the task and of its training for a number of worlds, changed as train.py would.

    Raises:
        UserError: If an argument makes no sense.
    """
    changes = {"num_envs": num_envs, "set": ["evaluation.interval=0", *args.set]}  # so that iterations are alike
    env_cfg, train_cfg = task_registry.get_cfgs(args.task, dataclasses.replace(options_of(args), **changes))
    check_env_cfg(env_cfg)  # a mistake in the last size is told before the first one is measured
    return env_cfg, train_cfg


def print_row(row: dict) -> None:
    """Print what was measured of one number of worlds."""
    if "error" in row:
        print(f"{row['num_envs']:>{width('worlds')},} | {row['error']}", flush=True)
        return
    cells = [f"{row[key]:>{width(title)},.{digits}f}" for key, (title, digits) in COLUMNS.items()]
    print(" | ".join(cells), flush=True)
    if "endurance" in row:
        numbers = row["endurance"]
        print(
            f"  {numbers['iterations']} iterations in a row: {numbers['first_ms']:.1f} ms in the first tenth, "
            f"{numbers['last_ms']:.1f} ms in the last ({100 * numbers['slowdown']:+.1f}%); "
            f"memory {numbers['first_memory_mib']:.0f} MiB, then {numbers['growth_mib']:+.1f} MiB"
        )


def print_kernels(kernels: list[dict], device: str, trace: Path) -> None:
    """Print what has taken most time in a trace."""
    kind = "torch operators (Warp's kernels show on a GPU only)" if device == "cpu" else "kernels"
    print(f"  most expensive {kind} of {TRACED} iterations, see {trace}:")
    print(f"  {'calls':>8}  {'total ms':>9}  name")
    if not kernels:
        print("  none was seen: torch's profiler needs CUPTI, and the permission to use it")
    for kernel in kernels:
        print(f"  {kernel['calls']:>8}  {kernel['total_ms']:>9.2f}  {kernel['name'][:110]}")


def width(title: str) -> int:
    """Return how wide a column is."""
    return max(len(title), 7)


if __name__ == "__main__":
    run_script(main)
