"""Measure speed and memory of training: ``python scripts/benchmark.py --num_envs 1024 4096``."""

import dataclasses
from pathlib import Path
from typing import Any

from legged_torque.envs import task_registry
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.utils import cli
from legged_torque.utils.devices import device_name, resolve_device
from legged_torque.utils.errors import UserError, is_out_of_memory
from legged_torque.utils.files import without_machine, write_json
from legged_torque.utils.limits import Count
from legged_torque.utils.runs import package_versions

COLUMNS = {
    "num_envs": (" worlds", 0),
    "physics_ms": ("physics ms", 2),
    "step_ms": ("step ms", 2),
    "rollout_ms": ("rollout ms", 1),
    "update_ms": ("update ms", 1),
    "log_ms": (" log ms", 1),
    "iteration_ms": ("iteration ms", 1),
    "iteration_steps_per_s": ("steps/s", 0),
    "peak_memory_mib": ("peak MiB", 0),
}
"""Heading of each column, as wide as the column, and its number of decimals."""
LEGEND = """\
  physics: one control step of physics alone, with its torques; step: env.step; iteration: all of it, with logging
  steps/s: over whole iterations; peak: {memory}"""


def main() -> None:
    """Measure every size, print tables, write JSON."""
    parser = cli.Parser(__doc__)
    cli.add_options(parser, *cli.SETTINGS)
    parser.add_argument("--num_envs", type=int, nargs="+", help="numbers of worlds; default: that of the task")
    parser.add_argument("--preset", help="training settings: parallel (the default) or paper (Table II)")
    parser.add_argument("--rounds", type=int, default=10, help="how often each part is timed; default: %(default)s")
    parser.add_argument("--json", type=Path, help="file to write")
    args = parser.parse_args()
    cli.check_args(args, rounds=Count)
    if args.num_envs and any(item.startswith("env.num_envs=") for item in args.set):
        raise UserError("--num_envs and --set env.num_envs cannot be given together")
    changes = ["evaluation.interval=0", *args.set]  # without evaluations iterations are alike
    sizes = []
    with cli.slow_imports():
        for num_envs in args.num_envs or [None]:
            options = dataclasses.replace(cli.options_of(args), num_envs=num_envs, set=changes)
            sizes.append(task_registry.get_new_cfgs(options))
            check_env_cfg(sizes[-1][0])  # report mistakes in any size before the first one is measured
        device = resolve_device(args.device)
        from legged_torque.benchmark.measure import MemoryMeter, measure
    if args.json:
        cli.check_output(args.json)
    result = {"task": args.task, "device": device_name(device), "versions": package_versions(), "rounds": args.rounds}
    result |= {"preset": args.preset or "parallel", "perturbation": args.perturbation or "none"}
    result |= {"ranges": args.ranges or "default", "motors": args.motors or "default", "set": without_machine(args.set)}
    result |= {name: rate for name in cli.CLOCKS if (rate := getattr(args, name))}
    memory = MemoryMeter(device)
    of_gpu = "GPU memory of torch and Warp together, without the CUDA context"
    print(f"{args.task} on {device_name(device)}, medians of {args.rounds} rounds")
    print(LEGEND.format(memory=of_gpu if memory.is_gpu else "peak resident memory of this process"))
    print(" | ".join(title for title, _ in COLUMNS.values()), flush=True)
    rows: list[dict[str, Any]] = []
    for cfgs in sizes:
        try:
            row = measure(args.task, cfgs, memory, args.rounds)
        except Exception as error:
            if not is_out_of_memory(error):
                raise
            row = {"num_envs": cfgs[0].env.num_envs, "error": "does not fit in memory"}
        memory.clear()
        rows.append(row | {"left_memory_mib": memory.used()})
        cells = [f"{row[key]:>{len(title)},.{digits}f}" for key, (title, digits) in COLUMNS.items() if key in row]
        print(" | ".join([*cells, *([row["error"]] if "error" in row else [])]), flush=True)
        if args.json:
            write_json(args.json, result | {"rows": rows})


if __name__ == "__main__":
    cli.run_script(main)
