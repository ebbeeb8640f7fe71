"""Run an exported policy in plain MuJoCo, without torch and Warp.

Examples:
    python scripts/sim2sim.py                                            # the last export of the last run
    python scripts/sim2sim.py logs/a1_torque_multihead/RUN/exported_1119
    python scripts/sim2sim.py exported --command 0.5 0 0 --video walk.mp4
    python scripts/sim2sim.py exported --viewer --robots 1
"""

import argparse
import contextlib
from pathlib import Path

from legged_torque import resource_path
from legged_torque.deploy.description import DESCRIPTION_FILE
from legged_torque.envs import LeggedRobotCfg, task_registry
from legged_torque.utils import cli
from legged_torque.utils.config import update_from_dict
from legged_torque.utils.devices import choose_offscreen_renderer
from legged_torque.utils.errors import UserError, counted, printable
from legged_torque.utils.files import write_json
from legged_torque.utils.limits import Count, NotNegative, Number, Share
from legged_torque.utils.options import choose_motors
from legged_torque.utils.runs import CONFIG_FILE, by_age, package_versions
from legged_torque.utils.task_registry import LOGS


def parse_args() -> argparse.Namespace:
    """Parse and check the command line."""
    parser = cli.Parser(__doc__)
    hint = "policy.yaml, policy.onnx, or the folder of both; default: the last export of the last run that has one"
    parser.add_argument("policy", type=Path, nargs="?", help=hint)
    parser.add_argument("--xml", type=Path, help="MJCF of the robot; default: that of the training")
    parser.add_argument("--steps", type=int, default=2000, help="control steps of each robot; default: %(default)s")
    parser.add_argument("--robots", type=int, default=16, help="robots, one after another; default: %(default)s")
    cli.add_command_arg(parser)
    hint = "largest velocity of a push per axis [m/s]; default: none"
    parser.add_argument("--push_velocity", type=float, default=0.0, help=hint)
    parser.add_argument("--push_probability", type=float, help="probability of a push per control step; default: 0.002")
    parser.add_argument("--seed", type=int, default=1, help="random seed; default: %(default)s")
    hint = "kinds of rough ground, or all; each robot starts on one of their tiles; default: the ground of training"
    parser.add_argument("--terrain", nargs="+", metavar="KIND", help=hint)
    hint = "difficulties of rough ground, 0 to 1; default: those of training"
    parser.add_argument("--level", nargs="+", type=float, default=(), help=hint)
    hint = "with height fields: corrected to those of training, or MuJoCo's own; default: %(default)s"
    parser.add_argument("--contacts", choices=("training", "mujoco"), default="training", help=hint)
    parser.add_argument("--video", type=cli.video_file, help="mp4 or gif of the first robot")
    parser.add_argument("--viewer", action="store_true", help="show it in real time in MuJoCo's window")
    parser.add_argument("--json", type=Path, help="JSON file of arguments and metrics to write")
    cli.add_options(parser, "motors", "task_file", "log_root")
    args = parser.parse_args()
    cli.check_args(args, steps=Count, robots=Count, seed=Number, command=list[float])
    cli.check_args(args, push_velocity=NotNegative, push_probability=Share)
    if args.level and not args.terrain:
        raise UserError("--level needs --terrain: the kinds of rough ground")
    if args.push_probability is not None and not args.push_velocity:
        raise UserError("--push_probability needs --push_velocity")
    if args.push_probability is None:
        args.push_probability = 0.002 if args.push_velocity else 0.0
    for file in filter(None, (args.json, args.video)):
        cli.check_output(file)
    return args


def main() -> None:
    """Load a policy and a robot, simulate, print the metrics, and write JSON and video if asked to."""
    args = parse_args()
    no_renderer = None if args.viewer else choose_offscreen_renderer()
    cli.options_of(args)  # imports files of tasks, which may add numpy functions of their terms
    with cli.slow_imports():
        from legged_torque.deploy.ground import select_ground
        from legged_torque.deploy.policy import Policy
        from legged_torque.deploy.robot import MujocoRobot
        from legged_torque.deploy.simulation import Simulation, evaluate
        from legged_torque.utils.metrics import UNITS, hide_nan
        from legged_torque.utils.mjcf import set_joints
        from legged_torque.viewer.native import simulation_window
        from legged_torque.viewer.video import SimulationRecorder
    args.policy = args.policy or last_export(Path(args.log_root or LOGS))
    policy = Policy(args.policy)
    if args.motors:
        cfg = task_registry.get_cfgs(policy.description["task"])[0]
        cfg.motors.restore(policy.description.get("motors", {}))
        update_from_dict(cfg.motors, {"delay": policy.description.get("latency", {}).get("actions", {})})
        delay = choose_motors(cfg, args.motors)
        policy.description["motors"] = cfg.motors.describe()
        if delay:  # as identify.py finds it: with that of measurements
            policy.description["latency"] = {"actions": getattr(cfg.motors, delay).described()}
    if args.terrain:
        select_ground(policy.description, LeggedRobotCfg().terrain, args.terrain, args.level)
    xml = args.xml or resource_path(policy.description["robot"]["file"])
    robot = MujocoRobot(xml, policy.description, args.contacts)
    if args.motors:
        set_joints(robot.model, cfg.motors.of_joints(policy.joint_order))
    simulation = Simulation(policy, robot, args.command, args.push_velocity, args.push_probability)
    notes = robot.notes + simulation.notes
    recorder = SimulationRecorder(simulation) if args.video else None
    with simulation_window(simulation) if args.viewer else contextlib.nullcontext(lambda: None) as show:
        training = policy.description["training"]
        what = f"{policy.description['task']}, {training['checkpoint']} of {training['run']}"
        for line in (f"{what}, in MuJoCo with '{xml}':", *(f"  note: {note}" for note in notes)):
            print(printable(line))

        def on_step(number: int) -> None:
            show()
            if recorder and number == 0:
                recorder.add_step()

        metrics = evaluate(simulation, args.robots, args.steps, args.seed, on_step)
    control_step = 1.0 / policy.description["timing"]["control_frequency"]
    print(f"  {counted(args.robots, 'robot')} x {counted(args.steps, 'step')} of {control_step:g} s")
    for name, value in metrics.items():
        print(hide_nan(f"  {name:<18} {value.mean:10.4f} +- {value.standard_error:.4f} {UNITS[name]}"))
    if args.json:
        result = {key: str(value) if isinstance(value, Path) else value for key, value in vars(args).items()}
        result |= {"task": policy.description["task"], "training": training, "notes": notes}
        result["versions"] = package_versions()
        result["metrics"] = {name: vars(estimate) for name, estimate in metrics.items()}
        write_json(args.json, result)  # in which null stands for values that were not measured
    if recorder:
        recorder.save(args.video, no_renderer)


def last_export(log_root: Path) -> Path:
    """Return the folder of the last policy that export.py has kept with a run; a UserError if there is none."""
    exports = list(log_root.glob(f"*/*/exported_*/{DESCRIPTION_FILE}"))
    if not exports:
        raise UserError(f"there is no exported policy in '{log_root}'; run export.py first, or name a policy")
    of_run = {file: (file.parents[1] / CONFIG_FILE).is_file() for file in exports}  # not of a policy from elsewhere
    return max(exports, key=lambda file: (of_run[file], by_age(file.parents[1]), file.stat().st_mtime)).parent


if __name__ == "__main__":
    cli.run_script(main, draws=True)
