"""Run an exported policy on a robot, or on a simulated one.

Examples:
    python scripts/deploy.py exported --interface sim                # a simulated robot in this process
    python scripts/deploy.py exported --interface lo --domain 1      # sim_robot.py in another terminal
    python scripts/deploy.py exported --interface eth0               # a Unitree Go2; never tried on hardware

Keys: s stand up, p policy, d or space damping, x no torque, arrows, comma and period the command, 0 stand still, q end.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Annotated, Any

from legged_torque import resource_path
from legged_torque.utils import cli
from legged_torque.utils.errors import UserError
from legged_torque.utils.interrupt import StopRequest
from legged_torque.utils.limits import Limits, Positive, Rate

LINE_EVERY = 1.0  # seconds between two lines of the state
ROBOT = "go2"  # at the other end of a network interface
POLL = 0.05  # seconds between two looks at the keys


def parse_args() -> argparse.Namespace:
    """Parse and check the command line."""
    parser = cli.Parser(__doc__)
    parser.add_argument("policy", type=Path, help="policy.yaml, policy.onnx, or the folder of both")
    hint = "network interface of a Unitree Go2, lo for sim_robot.py, or sim for a simulated robot in this process"
    parser.add_argument("--interface", required=True, help=hint)
    parser.add_argument("--domain", type=int, default=0, help="of DDS; Unitree's robots: 0; default: %(default)s")
    parser.add_argument("--rate", type=float, default=500.0, help="commands per second; default: %(default)s")
    parser.add_argument(
        "--command",
        type=float,
        nargs=3,
        metavar=("X", "Y", "YAW"),
        default=[0.0, 0.0, 0.0],
        help="first command: forwards, to the left [m/s], yaw rate [rad/s]; default: stand still",
    )
    parser.add_argument("--seconds", type=float, help="end after this time; default: when asked to")
    parser.add_argument("--walk", action="store_true", help="stand up and walk without being asked; simulation only")
    hint = "in place of the policy, move all joints of a robot that hangs in the air, for identify.py; default: 40 s"
    parser.add_argument("--chirp", type=float, nargs="?", const=40.0, metavar="SECONDS", help=hint)
    parser.add_argument("--log", type=Path, help="new MCAP file for every tick; replay.py reads it")
    args = parser.parse_args()
    cli.check_args(args, chirp=Annotated[float, Limits(10, 120)])
    cli.check_args(args, rate=Rate, seconds=Positive, command=list[float], domain=Annotated[int, Limits(0, 232)])
    if args.walk and args.interface not in ("sim", "lo"):
        raise UserError("--walk is for simulated robots (--interface sim or lo): a real one waits for its operator")
    return args


def main() -> None:
    """Connect, and obey the operator until the end."""
    args = parse_args()
    with cli.slow_imports():
        from legged_torque.deploy.policy import Policy
        from legged_torque.runtime.controller import Controller
        from legged_torque.runtime.loop import RealTimeLoop
        from legged_torque.runtime.operator import Operator
        from legged_torque.runtime.session import Session
    policy = chirp(args, Policy(args.policy)) if args.chirp else Policy(args.policy)
    transport = connect(args, policy)
    controller = Controller(policy, transport.joint_order, args.rate)
    session = Session(controller, transport, new_log(args.log, controller) if args.log else None)
    operator = Operator(controller, walks=args.walk)
    operator.command(args.command)
    end = time.monotonic() + (args.seconds or float("inf"))
    try:
        with StopRequest(lambda text: None) as stop, RealTimeLoop(args.rate, session.tick) as loop, operator:
            next_line = time.monotonic()
            while not stop.requested and not operator.has_ended and time.monotonic() < end and loop.error is None:
                if args.chirp and policy.has_ended:
                    break
                operator.look()
                if session.log:
                    session.log.write()
                if time.monotonic() >= next_line:
                    next_line += LINE_EVERY
                    print(session.line(loop), flush=True)
                time.sleep(POLL)
    finally:  # also where a line cannot be printed
        session.close()
    print("\n".join([session.line(loop), *(f"stopped: {reason}" for reason in session.stops)]))
    if loop.error is not None:
        raise loop.error
    if session.stops:
        sys.exit(1)


def new_log(file: Path, controller: Any) -> Any:
    """Return the log of a controller."""
    from legged_torque.runtime.log import Log

    return Log(file, controller)


def chirp(args: argparse.Namespace, policy: Any) -> Any:
    """Return sweeps in place of a policy, once the operator has said that the robot hangs; with sim it does."""
    from legged_torque.runtime.chirp import Chirp, confirm

    if args.interface != "sim":
        confirm()
    return Chirp(policy, args.rate, args.chirp)


def connect(args: argparse.Namespace, policy: Any) -> Any:
    """Return the transport to the robot."""
    if args.interface == "sim":
        from legged_torque.runtime.in_process import InProcess
        from legged_torque.runtime.sim_robot import SimRobot

        xml = resource_path(policy.description["robot"]["file"])
        return InProcess(SimRobot(xml, policy.joint_order, args.rate, hangs=bool(args.chirp)))
    from legged_torque.runtime.dds import Go2Robot

    if (trained := policy.description["robot"]["name"]) != ROBOT:
        raise UserError(
            f"the policy is of the robot '{trained}'; over a network there are only transports to '{ROBOT}'"
        )
    return Go2Robot(args.interface, args.domain)


if __name__ == "__main__":
    cli.run_script(main)
