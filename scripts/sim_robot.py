"""Simulate a Unitree robot that speaks DDS as a real one does, for deploy.py.

Examples:
    python scripts/sim_robot.py                                   # a Go2 on interface lo, domain 1, as unitree_mujoco
    python scripts/sim_robot.py --motors real --latency 5         # with its motors, which get commands 5 ms late
    python scripts/sim_robot.py --fault lost=0.3 --fault_at 20    # of whose messages a third is lost after 20 s
"""

import argparse
import dataclasses
import math
import time
from typing import Annotated

from legged_torque import resource_path
from legged_torque.utils import cli
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.interrupt import StopRequest
from legged_torque.utils.limits import Limits, NotNegative, Positive
from legged_torque.utils.options import choose_motors

RATE = 500.0  # messages per second, as a Go2
TASKS = {"go2": "go2_position"}  # whose settings have the robot's file and motors
LINE_EVERY = 1.0  # seconds between two lines of the state


def parse_args() -> argparse.Namespace:
    """Parse and check the command line."""
    parser = cli.Parser(__doc__)
    parser.add_argument("--robot", choices=tuple(TASKS), default="go2", help="default: %(default)s")
    parser.add_argument("--interface", default="lo", help="network interface; default: %(default)s")
    parser.add_argument("--domain", type=int, default=1, help="of DDS; default: %(default)s, as unitree_mujoco")
    parser.add_argument("--seconds", type=float, help="end after this time; default: with Ctrl-C")
    parser.add_argument("--motors", default="ideal", help="ideal, real, ..., or a file of identify.py; default: ideal")
    parser.add_argument("--latency", type=float, default=0.0, help="of commands [ms]; default: 0")
    hint = "lost, damaged (shares of messages), delay [s], silent=1; dead, hot or error=JOINT; may be repeated"
    parser.add_argument("--fault", action="append", default=[], metavar="NAME=VALUE", help=hint)
    parser.add_argument("--fault_at", type=float, default=0.0, help="second at which faults begin; default: at once")
    args = parser.parse_args()
    limits = {"domain": Annotated[int, Limits(0, 232)], "latency": Annotated[float, Limits(0, 1000)]}
    cli.check_args(args, seconds=Positive, fault_at=NotNegative, **limits)
    return args


def main() -> None:
    """Simulate until the end, and print a line now and then."""
    args = parse_args()
    with cli.slow_imports():
        from legged_torque.envs import task_registry
        from legged_torque.runtime.dds import Go2Side
        from legged_torque.runtime.loop import RealTimeLoop
        from legged_torque.runtime.sim_robot import Faults, SimRobot
        from legged_torque.runtime.unitree_go2 import encode_state
    cfg, _ = task_registry.get_cfgs(TASKS[args.robot])
    choose_motors(cfg, args.motors)
    side = Go2Side(args.interface, args.domain)
    motors = {"motors": cfg.motors, "latency": args.latency / 1e3}
    robot = SimRobot(resource_path(cfg.asset.file), side.joint_order, RATE, **motors)
    faults, start = with_faults(Faults(), args.fault, side.joint_order), time.monotonic()

    def tick(now: float, missed: bool) -> None:
        """Obey, move, and tell the state."""
        if now - start >= args.fault_at:
            robot.faults = faults
        robot.step(side.receive())
        state, is_damaged = robot.says()
        if state is not None:
            message = encode_state(state)
            message.crc ^= is_damaged
            side.publish(message)

    end = start + (args.seconds or math.inf)
    with StopRequest(lambda text: None) as stop, RealTimeLoop(RATE, tick) as loop:
        while not stop.requested and time.monotonic() < end and loop.error is None:
            time.sleep(LINE_EVERY)
            what = "damping" if robot.is_damping else "driven"
            place = " ".join(f"{part:+.2f}" for part in robot.data.qpos[:3])
            print(
                f"{what}; place {place}; watchdog {robot.watchdog_ticks}; beyond limits {robot.excess:.3g} N m",
                flush=True,
            )
    side.close()
    if loop.error is not None:
        raise loop.error


def with_faults(faults: object, words: list[str], joints: list[str]) -> object:
    """Return faults with those of NAME=VALUE; a UserError for one that does not exist."""
    kinds = [field.name for field in dataclasses.fields(faults) if field.name != "not_finite"]  # no message can say it
    for word in words:
        name, _, value = word.partition("=")
        if name not in kinds:
            raise unknown_name("fault", name, kinds)
        if isinstance(getattr(faults, name), list):
            if value not in joints:
                raise unknown_name("joint", value, joints)
            getattr(faults, name).append(value)
            continue
        try:
            setattr(faults, name, type(getattr(faults, name))(float(value)))
        except ValueError:
            raise UserError(f"--fault {name} takes a number, not '{value}'") from None
    return faults


if __name__ == "__main__":
    cli.run_script(main)
