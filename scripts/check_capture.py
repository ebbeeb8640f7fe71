"""Check that graphs and kernels of a GPU train as torch does without: ``python scripts/check_capture.py``."""

from __future__ import annotations

import sys
from dataclasses import astuple
from typing import TYPE_CHECKING

from legged_torque.envs import task_registry
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.utils.args import Parser, add_build_args, options_of
from legged_torque.utils.cli import check_at_least, run_script, slow_imports
from legged_torque.utils.devices import device_name, resolve_device
from legged_torque.utils.options import Options
from legged_torque.utils.task_registry import set_seed

if TYPE_CHECKING:
    from legged_torque.learning.runner import OnPolicyRunner


def main() -> None:
    """Train the task with and without CUDA graphs, print how far all numbers are apart, and judge."""
    parser = Parser(__doc__)
    add_build_args(parser)
    parser.add_argument("--iterations", type=int, default=1, help="iterations to compare; default: %(default)s")
    help_text = "how far a quantity may be off (root mean square, in parts of its own), unless two runs without graphs "
    help_text += "are as far apart; default: %(default)s"
    parser.add_argument("--tolerance", type=float, default=1e-2, help=help_text)
    args = parser.parse_args()
    check_at_least(args, 1, "iterations")
    check_at_least(args, 0, "tolerance")
    options = options_of(args)
    with slow_imports():
        check_env_cfg(task_registry.get_cfgs(options.task, options)[0])  # mistakes are told before anything is built
        device = resolve_device(args.device)
        from tools.capture import KERNEL_TOLERANCE, compare_capture, compare_kernels
    print(f"{args.task} on {device_name(device)}: with CUDA graphs against without")
    if device == "cpu":
        print("a CPU has no graphs: this compares two runs that are the same")
    plain, captured = (build_runner(options, capture) for capture in (False, True))
    too_far = []
    for iteration in range(args.iterations):
        print(f"{f'iteration {iteration}':<24} largest |  relative |       rms | rms of two without")
        for name, difference in compare_capture(plain, captured, seed=iteration).items():
            print(f"{name:<22}", " | ".join(f"{number:9.2e}" for number in astuple(difference)))
            if not difference.within(args.tolerance):
                too_far.append(f"{name} of iteration {iteration}")
    for network, error in compare_kernels(plain).items():
        print(f"gradient of {network}: kernels against torch's autograd {error:.2e} (norm of the difference)")
        if not error <= KERNEL_TOLERANCE:
            too_far.append(f"gradient of {network}")
    captured.close()
    if too_far:
        sys.exit(f"beyond the tolerance of {args.tolerance:g}: {', '.join(too_far)}")
    print(f"all within the tolerance of {args.tolerance:g}")


def build_runner(options: Options, capture: bool) -> OnPolicyRunner:
    """Build the task and its runner from the seed of the settings, and let everything that can be captured be so."""
    from tools.capture import warm_up

    env_cfg, train_cfg = task_registry.get_cfgs(options.task, options)
    train_cfg.runner.capture = capture
    set_seed(train_cfg.seed)
    env, _ = task_registry.make_env(options.task, options, env_cfg)
    runner, _ = task_registry.make_alg_runner(env, train_cfg=train_cfg, log_root=None)
    warm_up(runner)
    return runner


if __name__ == "__main__":
    run_script(main)
