"""Export a checkpoint for a robot: ``python scripts/export.py --task=a1_torque_multihead``."""

import os

os.environ["MUJOCO_GL"] = "disable"

from pathlib import Path

from legged_torque.deploy.export import export_policy, nominal_cfg
from legged_torque.envs import task_registry
from legged_torque.utils.args import Parser, add_task_args, run_script
from legged_torque.utils.runs import find_checkpoint
from legged_torque.utils.task_registry import load_run


def main() -> None:
    """Load a checkpoint and write policy.onnx, policy.pt and policy.yaml."""
    parser = Parser(__doc__)
    add_task_args(parser)
    parser.add_argument("--out", type=Path, help="folder to write; default: exported_<checkpoint> in the run's folder")
    args = parser.parse_args()
    run_dir, env_cfg, train_cfg = load_run(args)
    checkpoint = find_checkpoint(run_dir, args.checkpoint)
    env, _ = task_registry.make_env(args.task, args, nominal_cfg(env_cfg))
    runner, _ = task_registry.make_alg_runner(env, args.task, train_cfg=train_cfg, log_root=None)
    runner.load(str(checkpoint))
    iterations = runner.current_learning_iteration
    out = args.out or run_dir / f"exported_{iterations}"
    training = {
        "run": run_dir.name,
        "checkpoint": checkpoint.name,
        "iterations": iterations,
        "total_steps": int(env.total_steps),
    }
    difference = export_policy(env, runner.alg.get_policy(), out, args.task, training)
    print(f"{checkpoint}, after {training['total_steps']:,} steps of training:")
    print(f"  exported to {out}: policy.onnx, policy.pt, policy.yaml")
    print(f"  largest difference to the checkpoint's network: {difference:.2g}")


if __name__ == "__main__":
    run_script(main)
