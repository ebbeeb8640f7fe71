"""Standing trials of the whole-body controller and of a pre-trained policy."""

import copy
from typing import Any

from legged_torque.envs import task_registry
from legged_torque.paper.gravity.dynamics import RobotDynamics
from legged_torque.paper.gravity.pretrained import check_spaces, pretrained_file, start_from
from legged_torque.paper.gravity.pretraining import act_by_controller, act_by_policy, make_controller
from legged_torque.paper.gravity.standing import measure_standing, place_on_ground, use_standing_trials
from legged_torque.utils.cli import script_command
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import Options
from legged_torque.utils.task_registry import set_seed

SEED = 2  # of the random states, unless the command line has one; pre-training has 1


def check_standing(options: Options, env_cfg: Any, train_cfg: Any) -> None:
    """Print how often the controller stands up at 200 Hz, and controller and policy at the task's own frequency.

    Robots start from random states with the lowest foot just above the ground (:func:`place_on_ground`).

    Raises:
        UserError: If there is no pre-trained policy, or it does not fit the task.
    """
    file = pretrained_file(options.task, train_cfg, options.log_root)
    if not file.exists():
        raise UserError(f"there is no pre-trained policy '{file}'; make it first: {script_command('pretrain_gravity')}")
    check_spaces(file, env_cfg, train_cfg)
    print(f"{'':12} {'frequency':>9} {'after':>6} {'standing':>9} {'mean torque':>12}")
    own = env_cfg.control.decimation
    for name, decimation, seconds in (("controller", 1, 3.0), ("controller", own, 5.0), ("policy", own, 5.0)):
        cfg = copy.deepcopy(env_cfg)
        use_standing_trials(cfg, decimation)
        set_seed(SEED if options.seed is None else options.seed)
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
