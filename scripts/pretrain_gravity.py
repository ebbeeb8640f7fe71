"""Teach a torque policy to stand by supervision: ``python scripts/pretrain_gravity.py --task=a1_torque_gravity``.

The policy is kept where ``train.py`` looks for it, which also makes it itself if it is missing.
"""

import json
import os
from pathlib import Path

os.environ["MUJOCO_GL"] = "disable"  # nothing is drawn, and MuJoCo must not look for a renderer

from legged_torque.envs import task_registry
from legged_torque.learning.pretrained import make_pretrained, pretrained_file
from legged_torque.utils.args import Parser, add_build_args, device_name, resolve_device, run_script
from legged_torque.utils.cli import prepare_file
from legged_torque.utils.progress import CompileProgress


def main() -> None:
    """Parse the command line and make the policy."""
    parser = Parser(__doc__)
    add_build_args(parser)
    parser.set_defaults(task="a1_torque_gravity")
    parser.add_argument("--log_root", help="folder that keeps all experiments; default: ./logs")
    parser.add_argument("--num_configurations", type=int, help="random initial states; default: that of the task")
    parser.add_argument("--num_steps", type=int, help="control steps for which each is followed; default: likewise")
    parser.add_argument("--json", type=Path, help="write the report with its histograms to this file as well")
    args = parser.parse_args()
    for name in ("num_configurations", "num_steps", "seed"):
        if getattr(args, name) is not None:
            args.set.append(f"pretraining.{name}={getattr(args, name)}")
    env_cfg, train_cfg = task_registry.get_cfgs(args.task, args)
    file = pretrained_file(args, train_cfg)
    if args.json:
        prepare_file(args.json)
    print(f"Pre-training {args.task} on {device_name(resolve_device(args.device))}.", flush=True)
    with CompileProgress():
        report = make_pretrained(file, args, env_cfg, train_cfg)
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(f"The policy is in {file}")
    print(f"Train from it: python scripts/train.py --task={args.task}")


if __name__ == "__main__":
    run_script(main)
