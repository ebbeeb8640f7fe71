"""Play a log of deploy.py once more: does the policy do the same, and where does a simulated robot part from it?

Examples:
    python scripts/replay.py walk.mcap --policy exported
    python scripts/replay.py walk.mcap --policy exported --motors real --latency 5 --plot gap.png
"""

from pathlib import Path
from typing import Annotated

from legged_torque import resource_path
from legged_torque.utils import cli
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import Limits, Positive
from legged_torque.utils.options import simulated_latency


def main() -> None:
    """Print what has become of policy and robot."""
    parser = cli.Parser(__doc__)
    parser.add_argument("log", type=Path, help="MCAP file of deploy.py --log")
    parser.add_argument("--policy", type=Path, required=True, help="policy.yaml, policy.onnx, or the folder of both")
    hint = "of the simulated robot: ideal, real, ..., or a file of identify.py; default: ideal"
    parser.add_argument("--motors", default="ideal", help=hint)
    parser.add_argument("--latency", type=float, help="of its commands [ms]; default: that of a file of motors, or 0")
    parser.add_argument("--limit", type=float, default=0.1, help="gap at which they part [rad]; default: %(default)s")
    parser.add_argument("--plot", type=Path, help="figure of all joints; needs the extra 'plots'")
    cli.add_options(parser, "task_file")
    args = parser.parse_args()
    cli.check_args(args, latency=Annotated[float, Limits(0, 1000)], limit=Positive)
    if args.plot:
        cli.check_output(args.plot)
        if args.plot.suffix not in (".png", ".svg", ".pdf"):
            raise UserError(f"cannot write '{args.plot}': a figure needs a name that ends in .png, .svg or .pdf")
    cli.options_of(args)  # imports files of tasks
    with cli.slow_imports():
        from legged_torque.deploy.policy import Policy
        from legged_torque.envs import task_registry
        from legged_torque.runtime.chirp import CHECKSUM
        from legged_torque.runtime.log import RecordedLog
        from legged_torque.runtime.replay import same_actions, simulate
        from legged_torque.runtime.sim_robot import SimRobot

        if args.plot:
            from legged_torque.paper.plotting import load_pyplot, save_figure

            pyplot = load_pyplot()  # a UserError if it is missing
    log, policy = RecordedLog(args.log), Policy(args.policy)
    hangs = log.sha256 == CHECKSUM  # sweeps in place of a policy
    if hangs and log.task != (task := policy.description["task"]):
        raise UserError(f"the log is of the task '{log.task}', the policy of '{task}'")
    if not hangs:
        steps, equal = same_actions(log, policy)
        print(f"policy: {equal} of {steps} steps have the same actions, bit by bit")
    cfg = task_registry.get_cfgs(policy.description["task"])[0]
    cfg.motors.restore(policy.description.get("motors", {}))
    latency = simulated_latency(cfg, args.motors, args.latency)
    xml, rate = resource_path(policy.description["robot"]["file"]), 1.0 / log.period
    robot = SimRobot(xml, log.joint_order, rate, motors=cfg.motors, latency=latency, hangs=hangs)
    gap = simulate(log, robot)
    parts = gap.parts_at(args.limit)
    until = min(parts.min(), gap.times[-1])
    print(f"joint: parts by {args.limit:g} rad at [s]; rms gap in the first {until:.2f} s [rad]")
    for name, at, rms in zip(log.joint_order, parts, gap.rms(until), strict=True):
        print(f"  {name}: {'never' if at == float('inf') else f'{at:.2f}'}; {rms:.4f}")
    if args.plot:
        names, size = log.joint_order, {"figsize": (12, 8), "layout": "constrained"}
        figure, axes = pyplot.subplots(-(-len(names) // 3), 3, sharex=True, squeeze=False, **size)
        for axis, name, logged, simulated in zip(axes.flat, names, gap.logged.T, gap.simulated.T, strict=False):
            axis.plot(gap.times, logged, label="log")
            axis.plot(gap.times, simulated, label="simulated", linestyle="--")
            axis.set_title(name, fontsize="small")
        axes.flat[0].legend()
        figure.supxlabel("time [s]")
        figure.supylabel("joint position [rad]")
        save_figure(figure, args.plot)
        print(f"wrote {args.plot}")


if __name__ == "__main__":
    cli.run_script(main)
