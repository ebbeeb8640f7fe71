"""Watch a trained policy walk: ``python scripts/play.py --task=a1_torque_multihead``."""

from legged_torque.utils.rendering import choose_offscreen_renderer

NO_RENDERER = choose_offscreen_renderer()  # before anything imports mujoco

from pathlib import Path

from legged_torque.envs import task_registry
from legged_torque.evaluation.metrics import UNITS, measure
from legged_torque.evaluation.video import Recorder
from legged_torque.utils.args import Parser, add_task_args, run_script
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import find_checkpoint
from legged_torque.utils.task_registry import load_run, set_seed


def main() -> None:
    """Load a run, roll it out with mean actions, print how it walks, save a video."""
    parser = Parser(__doc__)
    add_task_args(parser)
    parser.set_defaults(num_envs=16, seed=1)
    parser.add_argument(
        "--steps", type=int, default=500, help="control steps, 50 of them a second; default: %(default)s"
    )
    parser.add_argument("--video", type=Path, help="mp4 to write; default: in the run's folder")
    args = parser.parse_args()
    if args.steps < 1:
        raise UserError(f"--steps must be at least 1, not {args.steps}")
    run_dir, env_cfg, train_cfg = load_run(args)
    checkpoint = find_checkpoint(run_dir, args.checkpoint)
    set_seed(args.seed)
    env, _ = task_registry.make_env(args.task, args, env_cfg)
    runner, _ = task_registry.make_alg_runner(env, args.task, train_cfg=train_cfg, log_root=None)
    runner.load(str(checkpoint))
    recorder = Recorder(env)
    policy = runner.get_inference_policy(env.device)
    metrics = measure(env, policy, args.steps, lambda commands: recorder.add_step())
    print(f"{checkpoint}, after {int(runner.logger.tot_timesteps):,} steps of training:")
    for name, value in metrics.means().items():
        print(f"  {name:<18} {value:8.4f} {UNITS[name]}")
    video = args.video or run_dir / "videos" / f"{checkpoint.stem}.mp4"
    try:
        if NO_RENDERER:
            raise UserError(NO_RENDERER)
        recorder.save(video)
        print(f"video: {video}")
    except UserError as error:
        print(f"no video: {error}")


if __name__ == "__main__":
    run_script(main)
