"""Train a policy: ``python scripts/train.py --task=a1_torque_multihead``.

On several GPUs of a machine: ``torchrun --standalone --nproc_per_node=2 scripts/train.py --task=a1_torque_multihead``.
"""

import argparse
import os

os.environ["MUJOCO_GL"] = "disable"  # training draws nothing, and MuJoCo must not look for a renderer

from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO
from legged_torque.learning.pretrained import find_pretrained, start_from
from legged_torque.utils import distributed
from legged_torque.utils.args import Parser, add_task_args, add_train_args, device_name, run_script
from legged_torque.utils.config import to_dict
from legged_torque.utils.errors import UserError
from legged_torque.utils.progress import CompileProgress
from legged_torque.utils.runs import find_checkpoint, save_config
from legged_torque.utils.task_registry import load_run, num_iterations, set_seed


def main() -> None:
    """Parse the command line and train."""
    parser = Parser(__doc__)
    add_task_args(parser)
    add_train_args(parser)
    parser.add_argument("--list", action="store_true", help="print all tasks and exit")
    args = parser.parse_args()
    if args.list:
        print("\n".join(task_registry.names()))
        return
    if args.resume:
        if args.preset:
            raise UserError("--preset cannot be given with --resume, which keeps the settings of the run")
        run_dir, env_cfg, train_cfg = load_run(args)
        args.load_run, args.preset = str(run_dir), args.run_config.get("preset")
        args.max_iterations = args.max_iterations or args.run_config.get("max_iterations")
        find_checkpoint(run_dir, args.checkpoint)  # a mistake is told before anything is built
    elif args.load_run or args.checkpoint is not None:
        raise UserError("--load_run and --checkpoint need --resume")
    else:
        env_cfg, train_cfg = task_registry.get_cfgs(args.task, args)
    set_seed(train_cfg.seed)
    with CompileProgress():
        train(args, env_cfg, train_cfg)


def train(args: argparse.Namespace, env_cfg: LeggedRobotCfg, train_cfg: LeggedRobotCfgPPO) -> None:
    """Build the task and train it, from a pre-trained policy if the task has one."""
    starts_pretrained = train_cfg.pretraining.function and not args.resume and distributed.rank() == 0
    pretrained = find_pretrained(args, env_cfg, train_cfg) if starts_pretrained else None
    env, _ = task_registry.make_env(args.task, args, env_cfg)
    runner, _ = task_registry.make_alg_runner(env, args.task, args, train_cfg)
    if pretrained:
        start_from(runner, pretrained)  # the other processes get the networks of the first one
    total = args.max_iterations or num_iterations(env, train_cfg)
    remaining = total - runner.current_learning_iteration
    if remaining < 1:
        raise UserError(f"the run has {runner.current_learning_iteration} iterations already; raise --max_iterations")
    if distributed.rank() == 0:
        runner.claim_log_dir()
        num_processes = distributed.world_size()
        settings = {"task": args.task, "preset": args.preset or "parallel", "device": env.device}
        settings |= {"processes": num_processes, "max_iterations": total}
        place = f"{num_processes} x " * (num_processes > 1) + device_name(env.device)
        print(f"Training {args.task} on {place}: {num_processes * env.num_envs} worlds, {total} iterations.")
        print(f"Curves: tensorboard --logdir {runner.log_dir}")
        print(f"See it learn: python scripts/play.py {run_words(args.task, runner.log_dir)} --viewer web", flush=True)
        save_config(runner.log_dir, settings | {"env": to_dict(env_cfg), "train": to_dict(train_cfg)})
    runner.learn(remaining, init_at_random_ep_len=True)
    if distributed.rank() == 0:
        print(f"The run is in {runner.log_dir}")
        for what, script in {"See it walk": "play", "Measure it": "evaluate", "Take it elsewhere": "export"}.items():
            print(f"{what}: python scripts/{script}.py {run_words(args.task, runner.log_dir)}")
    runner.close()


def run_words(task: str, run_dir: str) -> str:
    """Return the options with which other scripts find a run."""
    return f"--task={task} --load_run={run_dir}"


if __name__ == "__main__":
    run_script(main)
