"""Count how often controller and pre-trained policy stand up: ``python scripts/check_standing.py --num_envs 1000``.

Robots start from random states with the lowest foot just above the ground (``legged_torque.paper.gravity.standing``).
"""

import copy

from legged_torque.envs import task_registry
from legged_torque.utils.args import Parser, add_build_args, options_of
from legged_torque.utils.cli import run_script, script_command, slow_imports
from legged_torque.utils.errors import UserError
from legged_torque.utils.task_registry import set_seed


def main() -> None:
    """Measure the controller at 200 Hz, and controller and policy at the task's own frequency."""
    parser = Parser(__doc__)
    add_build_args(parser)
    parser.set_defaults(task="a1_torque_gravity", seed=2)
    parser.add_argument("--log_root", help="folder that keeps all experiments; default: logs/ in the current directory")
    args = parser.parse_args()
    options = options_of(args)
    with slow_imports():
        env_cfg, train_cfg = task_registry.get_cfgs(options.task, options)
        from legged_torque.learning.pretrained import check_spaces, pretrained_file, start_from
        from legged_torque.paper.gravity.dynamics import RobotDynamics
        from legged_torque.paper.gravity.pretraining import act_by_controller, act_by_policy, make_controller
        from legged_torque.paper.gravity.standing import measure_standing, place_on_ground, use_standing_trials
        from legged_torque.utils.progress import CompileProgress
    file = pretrained_file(options.task, train_cfg, options.log_root)
    if not file.exists():
        raise UserError(f"there is no pre-trained policy '{file}'; make it first: {script_command('pretrain_gravity')}")
    check_spaces(file, env_cfg, train_cfg)

    print(f"{'':12} {'frequency':>9} {'after':>6} {'standing':>9} {'mean torque':>12}")
    own = env_cfg.control.decimation
    with CompileProgress():
        for name, decimation, seconds in (("controller", 1, 3.0), ("controller", own, 5.0), ("policy", own, 5.0)):
            cfg = copy.deepcopy(env_cfg)
            use_standing_trials(cfg, decimation)
            set_seed(options.seed or 0)
            task, _ = task_registry.make_env(options.task, options, cfg)
            if name == "controller":
                act = act_by_controller(make_controller(task))
            else:
                runner, _ = task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=None)
                start_from(runner, file)
                act = act_by_policy(runner.alg.actor)
            place_on_ground(task, RobotDynamics(task.sim.mj_model, task.num_envs, task.device, task.foot_names))
            result = measure_standing(task, act, seconds)
            row = f"{name:12} {1.0 / (cfg.sim.dt * decimation):6.0f} Hz {seconds:4.0f} s {result.share:9.1%}"
            print(f"{row} {result.mean_torque:8.2f} N m", flush=True)


if __name__ == "__main__":
    run_script(main)
