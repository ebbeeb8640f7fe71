"""Export a checkpoint for a robot.

Examples:
    python scripts/export.py                                   # the last run's last checkpoint
    python scripts/export.py --load_run=RUN --checkpoint=500 --out=exported
    python scripts/export.py --task=go2_position --format=deploy_yaml    # Unitree's params/deploy.yaml as well
"""

import shlex
from pathlib import Path

from legged_torque.deploy.description import DESCRIPTION_FILE, place_of_results
from legged_torque.envs import task_registry
from legged_torque.utils import cli
from legged_torque.utils.files import path_inside
from legged_torque.utils.task_registry import LOGS


def main() -> None:
    """Load a checkpoint and write policy.onnx, policy.pt and policy.yaml; print what the latter does not describe."""
    parser = cli.Parser(__doc__)
    cli.add_options(parser, "task", "device", "set", "task_file", *cli.RUNS)
    hint = "also write what Unitree's C++ (deploy_yaml) or NVIDIA's package leapp reads"
    parser.add_argument("--format", choices=("deploy_yaml", "leapp"), help=hint)
    parser.add_argument("--out", type=Path, help="folder to write; default: exported_<checkpoint> in the run's folder")
    args = parser.parse_args()
    if args.out:
        cli.check_output(args.out / DESCRIPTION_FILE)
    options = cli.options_of(args)
    with cli.slow_imports():
        run = task_registry.load_run(options)
        from legged_torque.deploy.export import export_policy, nominal_cfg
        from legged_torque.deploy.policy import Policy
        from legged_torque.runtime.formats import WRITERS
    env, runner = task_registry.make_loaded(run, options, nominal_cfg(run.env_cfg))
    iterations = runner.current_learning_iteration
    place = place_of_results(run.folder, options.policy, options.log_root or LOGS)
    out = args.out or path_inside(place, f"exported_{iterations}")
    training = {"run": run.folder.name, "checkpoint": run.checkpoint.name}
    training |= {"iterations": iterations, "total_steps": runner.logger.tot_timesteps}
    difference, unsupported = export_policy(env, runner.alg.policy(), out, run.task, training, WRITERS.get(args.format))
    print(f"{run.checkpoint}, after {training['total_steps']:,} steps of training:")
    print(f"  exported to {out}: policy.onnx, policy.pt, policy.yaml{f', {args.format}' if args.format else ''}")
    print(f"  largest difference to the checkpoint's network: {difference:.2g}")
    supplied = Policy(out).supplied if not unsupported else []
    if supplied:
        print(f"  whoever runs it must supply {', '.join(supplied)}: there is no numpy function for it")
    elif unsupported:
        print("  policy.yaml does not describe the whole task, so sim2sim.py refuses it; the networks are complete:")
        print("".join(f"  - {problem}\n" for problem in unsupported), end="")
    else:
        words = shlex.join([str(out), *cli.option_words(options, "task_file")])
        print(f"See it in plain MuJoCo: {cli.script_command('sim2sim')} {words}")


if __name__ == "__main__":
    cli.run_script(main)
