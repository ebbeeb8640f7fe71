"""Teach a torque policy to stand by supervision.

Examples:
    python scripts/pretrain_gravity.py --task=a1_torque_gravity
    python scripts/pretrain_gravity.py --check_standing --num_envs=1000

The policy is kept where ``train.py`` looks for it, which also makes it itself if it is missing.
"""

import shlex
from pathlib import Path

from legged_torque.envs import task_registry
from legged_torque.utils import cli
from legged_torque.utils.devices import device_name, resolve_device
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import without_machine, write_json


def main() -> None:
    """Parse the command line, and make the policy or check it."""
    parser = cli.Parser(__doc__)
    own = ("perturbation", "ranges")  # robots stand in trials of their own
    cli.add_options(parser, *(name for name in cli.SETTINGS if name not in own), "num_envs", "log_root")
    parser.set_defaults(task="a1_torque_gravity")
    parser.add_argument("--num_configurations", type=int, help="random initial states; default: as in the task")
    parser.add_argument("--num_steps", type=int, help="control steps to follow each state; default: as in the task")
    parser.add_argument("--json", type=Path, help="write the report with its histograms to this file as well")
    hint = "count how often the controller, with its defaults, and the policy made before stand up; makes no policy"
    parser.add_argument("--check_standing", action="store_true", help=hint)
    args = parser.parse_args()
    for name in ("num_configurations", "num_steps", "json") if args.check_standing else ():
        if getattr(args, name) is not None:
            raise UserError(f"--{name} is for making a policy, which --check_standing does not do")
    if args.check_standing and any(item.startswith("pretraining.controller.") for item in args.set):
        raise UserError("pretraining.controller is for making a policy: --check_standing has the controller's defaults")
    for name in () if args.check_standing else ("num_configurations", "num_steps", "seed"):
        if getattr(args, name) is not None:
            args.set.append(f"pretraining.{name}={getattr(args, name)}")
    options = cli.options_of(args)
    with cli.slow_imports():
        env_cfg, train_cfg = task_registry.get_cfgs(options.task, options)
        from legged_torque.paper.gravity.pretrained import make_pretrained, pretrained_file
        from legged_torque.paper.gravity.trials import check_standing
        from legged_torque.utils.progress import CompileProgress
    if args.check_standing:
        with CompileProgress():
            check_standing(options, env_cfg, train_cfg)
        return
    file, device = pretrained_file(options.task, train_cfg, options.log_root), resolve_device(options.device)
    if args.json:
        cli.check_output(args.json)
    print(f"Pre-training {args.task} on {device_name(device)}.", flush=True)
    with CompileProgress():
        report = make_pretrained(file, args.task, env_cfg, train_cfg, device)
    if args.json:
        write_json(args.json, without_machine(report))
    print(f"The policy is in {file}")
    choosing = ("task_file", "task", "log_root", *cli.CLOCKS, "motors", "set")  # all of which choose the policy
    words = cli.option_words(args, *choosing)
    print(f"Train from it: {cli.script_command('train')} {shlex.join(words)}")


if __name__ == "__main__":
    cli.run_script(main)
