"""Draw what a task draws at random: ``python scripts/plot_randomization.py --out distributions.png``.

Builds 2000 worlds of a1_position with --perturbation low, unless told otherwise, and reads the numbers that physics and
controller use. Every random parameter of the task has a panel.
"""

import copy
from pathlib import Path

from legged_torque.envs import task_registry
from legged_torque.utils.args import add_build_args, options_of
from legged_torque.utils.cli import Parser, check_output, run_script, slow_imports
from legged_torque.utils.task_registry import set_seed


def main() -> None:
    """Build a task, read what it has drawn, and draw a panel per parameter."""
    parser = Parser(__doc__)
    add_build_args(parser)
    parser.set_defaults(task="a1_position", perturbation="low", num_envs=2000)
    parser.add_argument("--out", type=Path, required=True, help="picture to write (png, svg, pdf)")
    args = parser.parse_args()
    check_output(args.out)
    options = options_of(args)
    with slow_imports():
        env_cfg, train_cfg = task_registry.get_cfgs(options.task, options)
        from tools.distributions import draw_distributions
    set_seed(train_cfg.seed)
    fixed_cfg = copy.deepcopy(env_cfg)
    fixed_cfg.env.num_envs, fixed_cfg.domain_rand.randomize_parameters = 1, False
    fixed, _ = task_registry.make_env(options.task, options, fixed_cfg)
    task, _ = task_registry.make_env(options.task, options, env_cfg)
    draw_distributions(task, fixed, args.out)


if __name__ == "__main__":
    run_script(main)
