"""Measure every checkpoint of a run with mean actions: ``python scripts/learning_curve.py --task=a1_position``."""

from pathlib import Path

from legged_torque.envs import task_registry
from legged_torque.utils.args import Parser, add_task_args, options_of
from legged_torque.utils.cli import check_at_least, check_output, run_script, slow_imports
from legged_torque.utils.config import to_dict
from legged_torque.utils.devices import device_name
from legged_torque.utils.files import write_json
from legged_torque.utils.paths import without_machine
from legged_torque.utils.runs import checkpoint_numbers, find_checkpoint, package_versions
from legged_torque.utils.task_registry import set_seed

SEED_OFFSET = 1000  # added to the training's seed: worlds other than in training, but the same for every checkpoint


def main() -> None:
    """Evaluate the checkpoints in the order of training, print a line for each, write JSON."""
    parser = Parser(__doc__)
    add_task_args(parser)
    parser.set_defaults(num_envs=256)
    help_text = "control steps per checkpoint; default: %(default)s, an episode"
    parser.add_argument("--steps", type=int, default=1000, help=help_text)
    parser.add_argument("--json", type=Path, help="file to write; default: curve.json in the run's folder")
    args = parser.parse_args()
    check_at_least(args, 1, "steps")
    options = options_of(args)
    with slow_imports():
        run = task_registry.load_run(options)
        from legged_torque.envs.base.metrics import measure
    file = args.json or run.folder / "curve.json"
    check_output(file)
    env, _ = task_registry.make_env(args.task, options, run.env_cfg)
    runner, _ = task_registry.make_alg_runner(env, args.task, train_cfg=run.train_cfg, log_root=None)
    points = []
    for number in checkpoint_numbers(run.folder):
        infos = runner.load(str(find_checkpoint(run.folder, number)))
        set_seed(run.train_cfg.seed + SEED_OFFSET)
        means = measure(env, runner.get_inference_policy(env.device), args.steps).means()
        points.append({"steps": infos["total_timesteps"], "seconds": infos["seconds"], **means})
        texts = [f"{name} {mean:.4f}" for name, mean in means.items()]
        print(f"{infos['total_timesteps']:>12,} steps", *texts, sep="  ")
    settings = {"num_envs": env.num_envs, "num_steps": args.steps, "actions": "mean", "env": to_dict(run.env_cfg)}
    result = {"task": args.task, "seed": run.train_cfg.seed}
    result |= {"trained_with": run.config["train"], "trained_env": run.config["env"]}
    result |= {"device": device_name(env.device), "evaluation": settings, "versions": package_versions()}
    write_json(file, without_machine(result | {"points": points}))


if __name__ == "__main__":
    run_script(main)
