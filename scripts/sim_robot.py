"""Simulate a Unitree robot that speaks DDS as a real one does, for deploy.py.

Examples:
    python scripts/sim_robot.py                                   # a Go2 on interface lo, domain 1, as unitree_mujoco
    python scripts/sim_robot.py --motors real --latency 5         # with its motors, which get commands 5 ms late
    python scripts/sim_robot.py --fault lost=0.3 --fault_at 20    # of whose messages a third is lost after 20 s
"""

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from typing import Annotated, Any

from legged_torque import resource_path
from legged_torque.utils import cli
from legged_torque.utils.errors import UserError, check_names
from legged_torque.utils.interrupt import StopRequest
from legged_torque.utils.limits import Limits, NotNegative, Positive, Share, check_value
from legged_torque.utils.options import simulated_latency

RATE = 500.0  # messages per second, as a Go2
TASKS = {"go2": "go2_position"}  # whose settings have the robot's file and motors
LINE_EVERY = 1.0  # seconds between two lines of the state
FRAME = 1 / 60  # seconds between two drawings


def main() -> None:
    """Simulate until the end, and print a line now and then."""
    parser = cli.Parser(__doc__)
    parser.add_argument("--robot", choices=tuple(TASKS), default="go2", help="default: %(default)s")
    parser.add_argument("--interface", default="lo", help="network interface; default: %(default)s")
    parser.add_argument("--domain", type=int, default=1, help="of DDS; default: %(default)s, as unitree_mujoco")
    parser.add_argument("--seconds", type=float, help="end after this time; default: with Ctrl-C")
    parser.add_argument("--motors", default="ideal", help="ideal, real, ..., or a file of identify.py; default: ideal")
    parser.add_argument("--latency", type=float, help="of commands [ms]; default: that of a file of motors, or 0")
    hint = "lost, damaged (shares of messages), delay [s], push [m/s], silent=1; dead, hot or error=JOINT; "
    hint += "may be repeated"
    parser.add_argument("--fault", action="append", default=[], metavar="NAME=VALUE", help=hint)
    parser.add_argument("--fault_at", type=float, default=0.0, help="second at which faults begin; default: at once")
    parser.add_argument("--viewer", action="store_true", help="show it in MuJoCo's window, where the mouse pushes it")
    args = parser.parse_args()
    limits = {"domain": Annotated[int, Limits(0, 232)], "latency": Annotated[float, Limits(0, 1000)]}
    cli.check_args(args, seconds=Positive, fault_at=NotNegative, **limits)
    with cli.slow_imports():
        from legged_torque.envs import task_registry
        from legged_torque.runtime.dds import Go2Side
        from legged_torque.runtime.loop import RealTimeLoop
        from legged_torque.runtime.sim_robot import Faults, SimRobot
        from legged_torque.viewer.native import check_display
    if args.viewer:
        check_display("sim_robot.py without --viewer")
    cfg, _ = task_registry.get_cfgs(TASKS[args.robot])
    motors = {"latency": simulated_latency(cfg, args.motors, args.latency), "motors": cfg.motors}
    side = Go2Side(args.interface, args.domain)
    robot = SimRobot(resource_path(cfg.asset.file), side.joint_order, RATE, **motors)
    faults, start = with_faults(Faults(), args.fault, side.joint_order), time.monotonic()

    def tick(now: float, *_: float) -> None:
        """Obey, move, and tell the state."""
        if now - start >= args.fault_at:
            robot.faults = faults
        robot.step(side.receive())
        state, is_damaged = robot.says()
        if state is not None:
            side.send(state, is_damaged)

    end, next_line = start + (args.seconds or math.inf), start
    show = window(robot) if args.viewer else contextlib.nullcontext(lambda: True)
    with StopRequest(lambda text: None) as stop, RealTimeLoop(RATE, tick) as loop, show as draw:
        while not stop.requested and time.monotonic() < end and loop.error is None and draw():
            if time.monotonic() >= next_line:
                next_line += LINE_EVERY
                mode = side.sport_mode.name
                what = f"sport mode {mode}" if mode else "damping" if robot.is_damping else "driven"
                place = " ".join(f"{part:+.2f}" for part in robot.data.qpos[:3])
                numbers = f"watchdog {robot.watchdog_ticks}; beyond limits {robot.excess:.3g} N m"
                print(f"{what}; place {place}; {numbers}", flush=True)
            time.sleep(FRAME)
    side.close()
    if loop.error is not None:
        raise loop.error


@contextlib.contextmanager
def window(robot: Any) -> Iterator[Callable[[], bool]]:
    """Open a window, and give a function that shows the robot and returns whether the window is still open.

    It shows a copy of the state, so that the robot does not wait; forces of the mouse act on the robot.
    """
    import mujoco.viewer  # needs a screen

    shown = mujoco.MjData(robot.model)
    with mujoco.viewer.launch_passive(robot.model, shown, show_left_ui=False, show_right_ui=False) as handle:

        def draw() -> bool:
            shown.qpos[:] = robot.data.qpos
            mujoco.mj_forward(robot.model, shown)
            handle.sync()
            robot.data.xfrc_applied[:] = shown.xfrc_applied
            return handle.is_running()

        yield draw


def with_faults(faults: object, words: list[str], joints: list[str]) -> object:
    """Return faults with those of NAME=VALUE; a UserError for one that does not exist."""
    kinds = [field.name for field in dataclasses.fields(faults) if field.name != "not_finite"]  # no message can say it
    for word in words:
        name, _, value = word.partition("=")
        check_names("fault", [name], kinds)
        if isinstance(getattr(faults, name), list):
            check_names("joint", [value], joints)
            getattr(faults, name).append(value)
            continue
        try:
            number = check_value(f"--fault {name}", float(value), NotNegative if name in ("delay", "push") else Share)
        except ValueError:
            raise UserError(f"--fault {name} takes a number, not '{value}'") from None
        if isinstance(getattr(faults, name), bool) and number not in (0.0, 1.0):
            raise UserError(f"--fault {name} takes 0 or 1, not {value}")
        setattr(faults, name, type(getattr(faults, name))(number))
    return faults


if __name__ == "__main__":
    cli.run_script(main)
