"""Measure the speed of physics, steps and training: ``python scripts/benchmark.py --num_envs 1024 4096``."""

import os

os.environ["MUJOCO_GL"] = "disable"

import json
from pathlib import Path

from legged_torque.envs import task_registry
from legged_torque.evaluation.benchmark import summarize, time_parts
from legged_torque.utils.args import DEFAULT_TASK, Parser, device_name, resolve_device, run_script
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import package_versions

COLUMNS = {
    "num_envs": "worlds",
    "physics_ms": "physics ms",
    "step_ms": "step ms",
    "step_over_physics": "step/physics",
    "rollout_ms": "rollout ms",
    "update_ms": "update ms",
    "iteration_ms": "iteration ms",
    "iteration_over_physics": "iteration/physics",
    "physics_steps_per_s": "physics steps/s",
    "step_steps_per_s": "step steps/s",
    "iteration_steps_per_s": "training steps/s",
}


def main() -> None:
    """Time every number of worlds and print a table."""
    parser = Parser(__doc__)
    parser.add_argument("--task", default=DEFAULT_TASK, help="name of the task; default: %(default)s")
    parser.add_argument(
        "--num_envs", type=int, nargs="+", default=[4096], help="numbers of worlds; default: %(default)s"
    )
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda:N")
    parser.add_argument("--rounds", type=int, default=10, help="how often each part is timed; default: %(default)s")
    parser.add_argument("--json", type=Path, help="file to write the numbers to")
    args = parser.parse_args()
    if args.rounds < 1:
        raise UserError(f"--rounds must be at least 1, not {args.rounds}")
    device = resolve_device(args.device)
    print(f"{args.task} on {device_name(device)}; physics and step are one control step, training is an iteration")
    print(" | ".join(COLUMNS.values()))
    rows = []
    for num_envs in args.num_envs:
        env_cfg, train_cfg = task_registry.get_cfgs(args.task)
        env_cfg.env.num_envs = num_envs
        env = task_registry.get_task_class(args.task)(env_cfg, device)
        runner, _ = task_registry.make_alg_runner(env, train_cfg=train_cfg, log_root=None)
        rows.append(summarize(time_parts(runner, args.rounds), num_envs, train_cfg.runner.num_steps_per_env))
        print(" | ".join(f"{rows[-1][key]:>{len(title)}.{digits(rows[-1][key])}f}" for key, title in COLUMNS.items()))
    if args.json:
        result = {"task": args.task, "device": device_name(device), "versions": package_versions(), "rows": rows}
        args.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def digits(value: float) -> int:
    """Return how many decimals to print."""
    return 2 if value < 1000 and value != int(value) else 0


if __name__ == "__main__":
    run_script(main)
