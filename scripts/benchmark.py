"""Measure speed and memory of training: ``python scripts/benchmark.py --num_envs 1024 4096``."""

import os

from legged_torque.utils.rendering import without_renderer

without_renderer()  # before anything imports mujoco
os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # or torch's profiler writes to standard error when it starts

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
from legged_torque.utils.paths import without_machine
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
  physics: only the physics steps of one control step; step: env.step; iteration: a whole iteration, with logging
  x floor: iteration / (physics x control steps of a rollout); steps/s: over whole iterations
  peak: {memory}
  start-up: from building the task to the end of the second iteration, when everything is compiled and captured"""
MEMORY = {
    "cuda": "GPU memory of torch and Warp together, without the CUDA context",
    "cpu": "peak resident memory of this process",
}
MIN_WIDTH = 7
"""Least width of a column."""
MAX_NAME = 110
"""Characters of a kernel's name that are printed."""


def main() -> None:
    """Measure every size and print a table."""
    args = parse_args()
    device = resolve_device(args.device)
    changes = ["evaluation.interval=0", *args.set]  # without evaluations iterations are alike
    settings = [size_settings(args, num_envs, changes) for num_envs in args.num_envs or [None]]
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
        "set": without_machine(args.set),
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
    """Parse and check the command line.

    Raises:
        UserError: If an option is not valid.
    """
    parser = Parser(__doc__)
    add_settings_args(parser)
    parser.add_argument("--num_envs", type=int, nargs="+", help="numbers of worlds; default: that of the task")
    parser.add_argument("--preset", help="training settings: parallel (the default) or paper (Table II)")
    parser.add_argument("--rounds", type=int, default=10, help="how often each part is timed; default: %(default)s")
    parser.add_argument("--json", type=Path, help="file to write")
    parser.add_argument(
        "--profile", type=Path, help=f"write a trace of {TRACED} iterations for ui.perfetto.dev, as .json or .json.gz"
    )
    help_text = "also run N iterations and compare the first tenth with the last"
    parser.add_argument("--endurance", type=int, default=0, metavar="N", help=help_text)
    args = parser.parse_args()
    if args.rounds < 1:
        raise UserError(f"--rounds must be at least 1, not {args.rounds}")
    if args.endurance < 0:
        raise UserError(f"--endurance must be at least 0, not {args.endurance}")
    if args.profile and len(args.num_envs or [None]) > 1:
        raise UserError("--profile writes one trace: give one number of worlds")
    return args


def size_settings(args: argparse.Namespace, num_envs: int | None, changes: list[str]) -> tuple[Any, Any]:
    """Return the settings of the task and of its training, as train.py would have them, for a number of worlds.

    Raises:
        UserError: If a setting is not valid.
    """
    options = dataclasses.replace(options_of(args), num_envs=num_envs, set=changes)
    env_cfg, train_cfg = task_registry.get_cfgs(args.task, options)
    check_env_cfg(env_cfg)  # report mistakes in any size before the first one is measured
    return env_cfg, train_cfg


def print_row(row: dict[str, Any]) -> None:
    """Print the numbers of one size."""
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


def print_kernels(kernels: list[dict[str, Any]], device: str, trace: Path) -> None:
    """Print the most expensive entries of a trace."""
    kind = "torch operators (Warp's kernels show on a GPU only)" if device == "cpu" else "kernels"
    print(f"  most expensive {kind} of {TRACED} iterations, see {trace}:")
    print(f"  {'calls':>8}  {'total ms':>9}  name")
    if not kernels:
        print("  none: torch's profiler needs CUPTI and the permission to use it")
    for kernel in kernels:
        print(f"  {kernel['calls']:>8}  {kernel['total_ms']:>9.2f}  {kernel['name'][:MAX_NAME]}")


def width(title: str) -> int:
    """Return the width of a column."""
    return max(len(title), MIN_WIDTH)


if __name__ == "__main__":
    run_script(main)
