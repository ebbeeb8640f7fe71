"""Measure speed and memory of training: ``python scripts/benchmark.py --num_envs 1024 4096``."""

import os

from legged_torque.utils.interrupt import end_on_interrupt
from legged_torque.utils.rendering import without_renderer

end_on_interrupt()
without_renderer()  # before anything imports mujoco
os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # or torch's profiler writes to standard error when it starts

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from legged_torque.envs import task_registry
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.utils.args import Parser, add_settings_args, options_of
from legged_torque.utils.cli import check_at_least, check_output, importing, run_script, write_json
from legged_torque.utils.devices import device_name, resolve_device
from legged_torque.utils.errors import UserError, is_out_of_memory
from legged_torque.utils.paths import without_machine
from legged_torque.utils.runs import package_versions

COLUMNS = {
    "num_envs": (" worlds", 0),
    "physics_ms": ("physics ms", 2),
    "step_ms": ("step ms", 2),
    "rollout_ms": ("rollout ms", 1),
    "update_ms": ("update ms", 1),
    "log_ms": (" log ms", 1),
    "iteration_ms": ("iteration ms", 1),
    "iteration_over_physics": ("x floor", 2),
    "iteration_steps_per_s": ("steps/s", 0),
    "peak_memory_mib": ("peak MiB", 0),
    "startup_s": ("start-up s", 1),
}
"""Heading of each column, as wide as the column, and its number of decimals."""
LEGEND = """\
  physics: only the physics steps of one control step; step: env.step; iteration: a whole iteration, with logging
  x floor: iteration / (physics x control steps of a rollout); steps/s: over whole iterations
  peak: {memory}
  start-up: from building the task to the end of the second iteration, when everything is compiled and captured"""
ENDURANCE = """\
  {iterations} iterations in a row: {first_ms:.1f} ms in the first tenth, {last_ms:.1f} ms in the last \
({slowdown:+.1%}); memory {first_memory_mib:.0f} MiB, then {growth_mib:+.1f} MiB"""


def main() -> None:
    """Measure every size, print a table, write JSON."""
    args = parse_args()
    changes = ["evaluation.interval=0", *args.set]  # without evaluations iterations are alike
    sizes = []
    with importing():
        for num_envs in args.num_envs or [None]:
            options = dataclasses.replace(options_of(args), num_envs=num_envs, set=changes)
            sizes.append(task_registry.get_cfgs(args.task, options))
            check_env_cfg(sizes[-1][0])  # report mistakes in any size before the first one is measured
        from legged_torque.checks.benchmark import TRACED, MemoryMeter, measure
    for file in filter(None, (args.json, args.profile)):
        check_output(file)
    device = resolve_device(args.device)
    memory = MemoryMeter(device)
    of_gpu = "GPU memory of torch and Warp together, without the CUDA context"
    print(f"{args.task} on {device_name(device)}, medians of {args.rounds} rounds")
    print(LEGEND.format(memory=of_gpu if memory.is_gpu else "peak resident memory of this process"))
    print(" | ".join(title for title, _ in COLUMNS.values()), flush=True)
    result = {
        "task": args.task,
        "device": device_name(device),
        "versions": package_versions(),
        "preset": args.preset or "parallel",
        "perturbation": args.perturbation or "none",
        "ranges": args.ranges or "default",
        "set": without_machine(args.set),
        "rounds": args.rounds,
        "rows": [],
    }
    for cfgs in sizes:
        try:
            row = measure(args.task, cfgs, memory, args.rounds, args.endurance, args.profile)
        except Exception as error:
            if not is_out_of_memory(error):
                raise
            row = {"num_envs": cfgs[0].env.num_envs, "error": "does not fit in memory"}
        memory.clear()
        result["rows"].append(row | {"left_memory_mib": memory.used()})
        print_row(row)
        if "kernels" in row:
            kind = "kernels" if memory.is_gpu else "torch operators (Warp's kernels show on a GPU only)"
            print(f"  most expensive {kind} of {TRACED} iterations, see {args.profile}:")
            print_kernels(row["kernels"])
        if args.json:
            write_json(args.json, result)


def parse_args() -> argparse.Namespace:
    """Parse and check the command line."""
    parser = Parser(__doc__)
    add_settings_args(parser)
    parser.add_argument("--num_envs", type=int, nargs="+", help="numbers of worlds; default: that of the task")
    parser.add_argument("--preset", help="training settings: parallel (the default) or paper (Table II)")
    parser.add_argument("--rounds", type=int, default=10, help="how often each part is timed; default: %(default)s")
    parser.add_argument("--json", type=Path, help="file to write")
    help_text = "write a trace of a few iterations for ui.perfetto.dev, as .json or .json.gz"
    parser.add_argument("--profile", type=Path, help=help_text)
    help_text = "also run N iterations and compare the first tenth with the last"
    parser.add_argument("--endurance", type=int, default=0, metavar="N", help=help_text)
    args = parser.parse_args()
    check_at_least(args, 1, "rounds")
    check_at_least(args, 0, "endurance")
    if args.profile and len(args.num_envs or [None]) > 1:
        raise UserError("--profile writes one trace: give one number of worlds")
    return args


def print_row(row: dict[str, Any]) -> None:
    """Print the numbers of one size."""
    cells = [f"{row[key]:>{len(title)},.{digits}f}" for key, (title, digits) in COLUMNS.items() if key in row]
    if "error" in row:
        cells.append(row["error"])
    print(" | ".join(cells), flush=True)
    if "endurance" in row:
        print(ENDURANCE.format(**row["endurance"]))


def print_kernels(kernels: list[dict[str, Any]]) -> None:
    """Print the most expensive entries of a trace."""
    print(f"  {'calls':>8}  {'total ms':>9}  name")
    if not kernels:
        print("  none: torch's profiler needs CUPTI and the permission to use it")
    for kernel in kernels:
        print(f"  {kernel['calls']:>8}  {kernel['total_ms']:>9.2f}  {kernel['name'][:110]}")


if __name__ == "__main__":
    run_script(main)
