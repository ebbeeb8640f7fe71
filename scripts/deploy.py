"""Run an exported policy on a robot, or on a simulated one.

Examples:
    python scripts/deploy.py exported --interface sim                # a simulated robot in this process
    python scripts/deploy.py exported --interface lo                 # sim_robot.py in another terminal
    python scripts/deploy.py exported --interface eth0               # a Unitree Go2; never tried on hardware
    python scripts/deploy.py exported --interface sdk --gamepad      # an A1 or Go1; never tried on hardware

Keys: s stand up, p policy, d or space damping, x no torque, arrows, comma and period the command, 0 stand still, q end.
"""

import argparse
import contextlib
import importlib
import os
import sys
import threading
import time
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Annotated, Any

from legged_torque import resource_path
from legged_torque.utils import cli
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import importable
from legged_torque.utils.interrupt import StopRequest
from legged_torque.utils.limits import Limits, Positive, Rate

ROBOT = "go2"  # at the other end of a network interface
POLL = 0.01  # seconds between two looks at keys and other devices


def parse_args() -> argparse.Namespace:
    """Parse and check the command line."""
    parser = cli.Parser(__doc__)
    parser.add_argument("policy", type=Path, help="policy.yaml, policy.onnx, or the folder of both")
    parser.add_argument("--robot", help="name of the robot at the other end; default: the policy's")
    hint = "network interface of a Unitree Go2, lo for sim_robot.py, sim for a simulated robot in this process, "
    hint += "sdk for an A1 or Go1 through unitree_legged_sdk, or FILE.py:CLASS, a transport of your own"
    parser.add_argument("--interface", required=True, help=hint)
    parser.add_argument("--domain", type=int, help="of DDS alone; default: 1 on lo, as sim_robot.py, else 0, Unitree's")
    hint = "commands per second; default: the largest multiple of the policy's rate up to 500; "
    hint += "sim_robot.py damps after 15 ms without one"
    parser.add_argument("--rate", type=float, help=hint)
    cli.add_command_arg(parser, "first", "stand still")
    hint = "obey JSON datagrams on a port of this machine, or of one of its addresses; docs/howto/run_on_robot.md"
    parser.add_argument("--udp", metavar="[ADDRESS:]PORT", help=hint)
    hint = "obey a gamepad; default: %(const)s"
    parser.add_argument("--gamepad", nargs="?", const="/dev/input/js0", metavar="DEVICE", help=hint)
    hint = "with --interface sdk: limit of the SDK's PowerProtect, 1 to 10 for 10 to 100%%; default: 1"
    parser.add_argument("--power", type=int, help=hint)
    parser.add_argument("--seconds", type=float, help="end after this time; default: when asked to")
    parser.add_argument("--walk", action="store_true", help="stand up and walk without being asked; simulation only")
    hint = "in place of the policy, move all joints of a robot that hangs in the air, for identify.py; default: 40 s"
    parser.add_argument("--chirp", type=float, nargs="?", const=40.0, metavar="SECONDS", help=hint)
    parser.add_argument("--log", type=Path, help="new MCAP file for every tick; replay.py reads it")
    args = parser.parse_args()
    cli.check_args(args, rate=Rate, seconds=Positive, command=list[float], domain=Annotated[int, Limits(0, 232)])
    cli.check_args(args, power=Annotated[int, Limits(1, 10)], chirp=Annotated[float, Limits(10, 120)])
    if args.power and args.interface != "sdk":
        raise UserError("--power is for --interface sdk: it limits unitree_legged_sdk's motors")
    if args.domain is not None and (args.interface in ("sim", "sdk") or ".py:" in args.interface):
        raise UserError("--domain is of DDS, which --interface sim, sdk and FILE.py:CLASS do without")
    if args.chirp and args.command:
        raise UserError("--command is for policies: --chirp has sweeps in place of one")
    if args.walk and args.interface not in ("sim", "lo"):
        raise UserError("--walk is for simulated robots (--interface sim or lo): a real one waits for its operator")
    return args


def main() -> None:
    """Connect, and obey the operator until the end."""
    args = parse_args()
    with cli.slow_imports():
        from legged_torque.deploy.policy import Policy
        from legged_torque.runtime.controller import Controller, default_rate
        from legged_torque.runtime.loop import RealTimeLoop
        from legged_torque.runtime.operator import Datagrams, Gamepad, Keyboard, Unattended
        from legged_torque.runtime.session import Session
        from legged_torque.runtime.view import View
    policy: Any = Policy(args.policy)
    args.rate = args.rate or default_rate(policy.description["timing"]["control_frequency"])
    if args.chirp:
        from legged_torque.runtime.chirp import Chirp, confirm

        policy = Chirp(policy, args.rate, args.chirp)
        if args.interface != "sim":  # in which it does hang
            confirm()
    transport = connect(args, policy)
    controller = Controller(policy, transport.joint_order, args.rate)
    operators: list[Any] = [Keyboard(controller), *([Unattended(controller)] if args.walk else [])]
    operators[0].begin_with(args.command or [0.0, 0.0, 0.0])
    devices = [(Datagrams, args.udp), (Gamepad, args.gamepad)]
    operators += [kind(controller, address) for kind, address in devices if address]
    is_alone = args.walk and len(operators) == 2 and not sys.stdin.isatty()  # nobody can have it stand up again
    log = None
    if args.log:
        from legged_torque.runtime.log import Log

        log = Log(args.log, controller, keeps_time=args.interface != "sim")
    session = Session(controller, transport, log)
    loop = RealTimeLoop(args.rate, session.tick)
    view, end = View(session, loop, operators), time.monotonic() + (args.seconds or float("inf"))
    ended, aside = threading.Event(), ThreadPoolExecutor()

    def repeat(act: Callable[[], None]) -> None:
        """Act again and again, in a thread of its own: a disk or a terminal may keep it waiting, and nothing else."""
        with contextlib.suppress(OSError, AttributeError):  # as other programs, after the loop
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        while not ended.wait(POLL):
            act()

    with StopRequest(lambda text: None) as stop, contextlib.ExitStack() as parts:
        for part in (view.live, *operators, aside, contextlib.closing(session), loop):  # left in the reverse order
            parts.enter_context(part)
        parts.callback(ended.set)
        repeated = [aside.submit(repeat, act) for act in (partial(say, view.show), *([log.write] if log else []))]
        while not (stop.requested or time.monotonic() > end or loop.error or any(each.done() for each in repeated)):
            for operator in operators:
                operator.look()
            if any(each.has_ended for each in (*operators, *([policy] if args.chirp else []))):
                break
            if is_alone and session.stops:
                break
            time.sleep(POLL)
    for each in repeated:
        each.result()
    said = "\n".join([view.line(), *(f"stopped: {reason}" for reason in session.stops)])
    say(lambda: print(said, flush=True))
    if loop.error is not None:
        raise loop.error
    if session.stops:
        sys.exit(1)


def say(write: Callable[[], None]) -> None:
    """Write to standard output; once that fails, as behind ``| head``, all goes nowhere: the robot must walk on."""
    try:
        write()
    except BlockingIOError:  # full just now
        pass
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def connect(args: argparse.Namespace, policy: Any) -> Any:
    """Return the transport to the robot; a UserError if the policy is of another one, or may ask for more torque."""
    trained = policy.description["robot"]["name"]
    if args.robot not in (None, trained):
        raise UserError(f"--robot must be '{trained}', of which the policy is, not '{args.robot}'")
    if args.interface == "sim":
        from legged_torque.runtime.sim_robot import InProcess, SimRobot

        xml = resource_path(policy.description["robot"]["file"])
        return InProcess(SimRobot(xml, policy.joint_order, args.rate, hangs=bool(args.chirp)))
    transport = outside(args, trained)
    for joint, most in zip(transport.joint_order, transport.torque_limits, strict=True):
        asked = max(map(abs, policy.description["torque_limits"].get(joint, [0.0])))
        if asked > most * (1.0 + 1e-6):  # limits of exports were float32
            raise UserError(f"the policy may ask {joint} for {asked:g} N m, the robot's motor can give {most:g} N m")
    return transport


def outside(args: argparse.Namespace, trained: str) -> Any:
    """Return the transport to a robot outside of this process, of the name with which a policy was trained."""
    if ".py:" in args.interface:  # code of the user's, who names it here
        file, _, name = args.interface.rpartition(":")
        kind = getattr(importlib.import_module(importable(Path(file), "--interface FILE.py:CLASS")), name, None)
        if not isinstance(kind, type):
            raise UserError(f"'{file}' has no class '{name}'")
        try:
            transport = kind()
        except TypeError as error:
            if error.__traceback__ and error.__traceback__.tb_next:  # a mistake in its own code
                raise
            raise UserError(f"'{args.interface}' must be a class that is made without arguments: {error}") from None
        joints, limits = (getattr(transport, name, None) for name in ("joint_order", "torque_limits"))
        both = ((joints, str), (limits, Real))
        fits = all(isinstance(part, Collection) and all(isinstance(each, kind) for each in part) for part, kind in both)
        if not fits or len(joints) != len(limits):
            raise UserError(f"'{args.interface}' must have joint_order, names, and as many torque_limits, numbers")
        return transport
    if args.interface == "sdk":
        from legged_torque.runtime.legged_sdk import LeggedSdkRobot

        return LeggedSdkRobot(trained, args.power or 1)
    from legged_torque.runtime.dds import Go2Robot

    if trained != ROBOT:
        others = f"DDS leads to a '{ROBOT}', --interface sdk to A1 and Go1"
        raise UserError(f"the policy is of the robot '{trained}'; {others}")
    return Go2Robot(args.interface, int(args.interface == "lo") if args.domain is None else args.domain)


if __name__ == "__main__":
    cli.run_script(main)
