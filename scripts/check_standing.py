"""Count how often controller and pre-trained policy stand up: ``python scripts/check_standing.py --num_envs 1000``.

Robots start from random states with the lowest foot just above the ground (``legged_torque.control.standing``).
"""

import copy
from collections.abc import Callable
from typing import Any

from legged_torque.utils.rendering import without_renderer

without_renderer()  # before anything imports mujoco

from torch import Tensor

from legged_torque.control.dynamics import RobotDynamics
from legged_torque.control.gravity_pretraining import act_by_controller, act_by_policy, make_controller
from legged_torque.control.standing import StandingResult, measure_standing, place_on_ground, use_standing_trials
from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.learning.pretrained import check_spaces, pretrained_file, start_from
from legged_torque.utils.args import Parser, add_build_args, options_of
from legged_torque.utils.cli import run_script
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import Options
from legged_torque.utils.progress import CompileProgress
from legged_torque.utils.task_registry import set_seed


def main() -> None:
    """Measure the controller at 200 Hz, and controller and policy at the task's own frequency."""
    parser = Parser(__doc__)
    add_build_args(parser)
    parser.set_defaults(task="a1_torque_gravity", seed=2)
    parser.add_argument("--log_root", help="folder that keeps all experiments; default: logs/ in the current directory")
    args = parser.parse_args()
    options = options_of(args)
    env_cfg, train_cfg = task_registry.get_cfgs(options.task, options)
    file = pretrained_file(options.task, train_cfg, options.log_root)
    if not file.exists():
        raise UserError(f"there is no pre-trained policy '{file}'; run scripts/pretrain_gravity.py first")
    check_spaces(file, env_cfg, train_cfg)

    def learned(task: LeggedRobot) -> Callable[[LeggedRobot], Tensor]:
        runner, _ = task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=None)
        start_from(runner, file)
        return act_by_policy(runner.alg.actor)

    def controlled(task: LeggedRobot) -> Callable[[LeggedRobot], Tensor]:
        return act_by_controller(make_controller(task))

    print(f"{'':12} {'frequency':>9} {'after':>6} {'standing':>9} {'mean torque':>12}")
    decimation = env_cfg.control.decimation
    trials = [("controller", controlled, 1, 3.0), ("controller", controlled, decimation, 5.0)]
    trials.append(("policy", learned, decimation, 5.0))
    with CompileProgress():
        for name, actor, steps, seconds in trials:
            result = trial(options, env_cfg, actor, steps, seconds)
            frequency = 1.0 / (env_cfg.sim.dt * steps)
            row = f"{name:12} {frequency:6.0f} Hz {seconds:4.0f} s {result.share:9.1%}"
            print(f"{row} {result.mean_torque:8.2f} N m", flush=True)


def trial(options: Options, env_cfg: Any, make_actor: Callable, decimation: int, seconds: float) -> StandingResult:
    """Let something act in a new task that starts from random states."""
    cfg = copy.deepcopy(env_cfg)
    use_standing_trials(cfg, decimation)
    set_seed(options.seed or 0)
    task, _ = task_registry.make_env(options.task, options, cfg)
    act = make_actor(task)
    place_on_ground(task, RobotDynamics(task.sim.mj_model, task.num_envs, task.device, task.foot_names))
    return measure_standing(task, act, seconds)


if __name__ == "__main__":
    run_script(main)
