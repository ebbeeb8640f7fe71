"""Inject faults while a simulated Go2 stands or walks, over DDS and in real time: ``python -m tools.faults EXPORT``.

Two processes, as ``sim_robot.py`` and ``deploy.py``: the robot, and a program that runs the exported policy. For each
fault, at a random moment, the time is measured until a command arrives at the robot that only damps, or until its
watchdog damps; and how far torques were asked for beyond their limits until then, in any physics step.
"""

import multiprocessing as mp
import os
import signal
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from legged_torque import resource_path
from legged_torque.deploy.policy import Policy
from legged_torque.runtime.brakes import Brakes
from legged_torque.runtime.controller import Controller, Mode, default_rate
from legged_torque.runtime.dds import Go2Robot, Go2Side
from legged_torque.runtime.interface import MotorCommand
from legged_torque.runtime.loop import RealTimeLoop
from legged_torque.runtime.session import Session
from legged_torque.runtime.sim_robot import Faults, SimRobot
from legged_torque.utils.cli import Parser, check_args, check_output, run_script
from legged_torque.utils.display import Counter
from legged_torque.utils.errors import UserError
from legged_torque.utils.files import write_json
from legged_torque.utils.interrupt import StopRequest
from legged_torque.utils.limits import Count
from legged_torque.utils.runs import package_versions

RATE = 500.0  # messages per second, as a Go2
STAND_UP = 0.05  # seconds; the robot is put on its feet
LIMIT = 0.2  # seconds after which a fault counts as unnoticed
COMMAND = (0.5, 0.0, 0.2)
GIVE_UP = 20  # trials in a row before whose fault the robot was stopped
OF_ROBOT: dict[str, Callable[[SimRobot], Any]] = {
    "silent": lambda robot: setattr(robot.faults, "silent", True),
    "states 100 ms late": lambda robot: setattr(robot.faults, "delay", 0.1),
    "damaged states": lambda robot: setattr(robot.faults, "damaged", 1.0),
    "hot motor": lambda robot: robot.faults.hot.append("RR_calf_joint"),
    "error flag": lambda robot: robot.faults.error.append("FL_hip_joint"),
    "on its side": lambda robot: robot.data.qpos.__setitem__(slice(3, 7), [np.cos(0.7), np.sin(0.7), 0.0, 0.0]),
    "joint too fast": lambda robot: robot.data.qvel.__setitem__(slice(6, 9), 200.0),
    "joint beyond its range": lambda robot: robot.data.qpos.__setitem__(7, 1.6),
}
"""What goes wrong with the robot. Its messages cannot say that a number is not finite."""
OF_POLICY = ("policy not finite", "policy out of range")
OF_PROGRAM = (*OF_POLICY, "error in the program", "late ticks", "operator")
"""And with the program; late ticks take 4 ms more each."""
HALTED = "program halted"  # so that only the robot's watchdog is left
KINDS = (*OF_ROBOT, *OF_PROGRAM, HALTED)


def program(export: Path, domain: int, rate: float, pipe: Connection) -> None:
    """Run a policy, and obey a pipe: modes, and what is to go wrong; "mend" ends all of it.

    The time of a broken policy is that of its first action, told when "asked"; None if there was none.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends this one
    policy = Policy(export)
    transport = Go2Robot("lo", domain)
    controller = Controller(policy, transport.joint_order, rate, Brakes(stand_up=STAND_UP))
    controller.velocity_command = np.array(COMMAND)
    network, receive, num_actions = policy.session, transport.receive, policy.description["network"]["num_actions"]

    def late() -> Any:
        """Return what has come, after a while."""
        time.sleep(0.004)
        return receive()

    asked: list[float] = []  # when a broken network was

    def answer(number: float) -> None:
        """Let the network answer this number."""

        def run(*_: Any) -> list[np.ndarray]:
            """Answer."""
            asked.append(time.monotonic())
            return [np.full((1, num_actions), number, np.float32)]

        asked.clear()
        policy.session = SimpleNamespace(run=run)

    def mend() -> None:
        """Let all work again."""
        policy.session, controller.brakes.max_tilt = network, Brakes.max_tilt
        vars(transport).pop("receive", None)

    words: dict[str, Callable[[], Any]] = {
        "policy not finite": lambda: answer(np.nan),
        "policy out of range": lambda: answer(1e6),
        "error in the program": lambda: setattr(controller.brakes, "max_tilt", "a mistake"),
        "late ticks": lambda: vars(transport).update(receive=late),
        "operator": lambda: controller.request(Mode.DAMPING),
        "asked": lambda: asked[0] if asked else None,
        "mend": mend,
        **{mode.value: partial(controller.request, mode) for mode in (Mode.STAND, Mode.POLICY)},
    }
    with RealTimeLoop(rate, Session(controller, transport).tick) as loop:
        while loop.error is None and (word := pipe.recv()) != "end":
            pipe.send((time.monotonic(), words[word]()))
    transport.close()
    if loop.error is not None:
        raise loop.error


class Robot:
    """The robot's process: its side of DDS.

    Attributes:
        side: Its end of DDS.
        robot: The robot.
        damps_since: Time since which it only damps [s]; None if it does more.
        begun: When the last change was made [s].
    """

    def __init__(self, xml: Path, domain: int) -> None:
        """Prepare the robot, lying."""
        self.side = Go2Side("lo", domain)
        self.robot = SimRobot(xml, self.side.joint_order, RATE)
        self.damps_since: float | None = None
        self.begun = 0.0
        self._change: Callable[[SimRobot], Any] | None = None

    def change(self, function: Callable[[SimRobot], Any]) -> None:
        """Have a function called before the next physics step, and wait for it."""
        self._change = function
        end = time.monotonic() + 10.0
        while self._change is not None:
            time.sleep(1e-4)
            if time.monotonic() > end:
                raise TimeoutError("the robot's loop has ended")

    def tick(self, *_: float) -> None:
        """Obey, move, and tell the state."""
        if self._change is not None:
            self._change(self.robot)
            self.begun, self._change = time.monotonic(), None
        received = self.side.receive()
        command = received.newest
        self.robot.step(received)
        if isinstance(command, MotorCommand) and (command.kp.any() or command.tau.any()):
            self.damps_since = None
        elif self.damps_since is None and (command is not None or self.robot.is_damping):
            self.damps_since = time.monotonic()
        state, is_damaged = self.robot.says()
        if state is not None:
            self.side.send(state, is_damaged)


def on_its_feet(robot: SimRobot) -> None:
    """Put a robot upright, at rest, without faults."""
    robot.data.qpos[:], robot.data.qvel[:] = robot.model.key_qpos[0], 0.0
    robot.faults, robot.excess = Faults(), 0.0


def trial(name: str, side: Robot, pipe: Connection, pid: int, rng: np.random.Generator) -> dict[str, Any] | None:
    """Inject a fault, and return what came of it; nothing if something else had stopped the robot before."""

    def tell(word: str) -> tuple[float, Any]:
        """Tell the program, and return when it did what, and its answer."""
        try:
            pipe.send(word)
            return pipe.recv()
        except (EOFError, OSError):
            raise UserError("the program with the policy has ended, see above") from None

    tell("mend")
    side.change(on_its_feet)
    time.sleep(0.15)
    refused = tell(Mode.STAND.value)[1]
    time.sleep(STAND_UP + 0.05)
    walks = name in OF_POLICY or rng.random() < 0.7
    refused = refused or (walks and tell(Mode.POLICY.value)[1])
    time.sleep(rng.uniform(0.02, 0.6))
    if refused or side.damps_since is not None:
        return None
    if name in OF_ROBOT:
        side.change(OF_ROBOT[name])
        begun = side.begun
    elif name == HALTED:
        begun = time.monotonic()
        os.kill(pid, signal.SIGSTOP)
    else:
        begun, _ = tell(name)
    end = time.monotonic() + LIMIT
    try:
        while side.damps_since is None and time.monotonic() < end:
            time.sleep(1e-3)
        ended, excess = side.damps_since, side.robot.excess
    finally:
        os.kill(pid, signal.SIGCONT)
    if name in OF_POLICY:
        begun = tell("asked")[1]
    if begun is None or (ended is not None and ended < begun):
        return None
    return {"fault": name, "walks": walks, "ms": ended and 1e3 * (ended - begun), "excess": excess}


def main() -> None:
    """Run all trials, print a table, write JSON."""
    parser = Parser(__doc__)
    parser.add_argument("export", type=Path, help="policy.yaml, policy.onnx, or the folder of both, of a Go2")
    parser.add_argument("--trials", type=int, default=1008, help="faults, of all kinds in turns; default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of the moments; default: %(default)s")
    parser.add_argument("--json", type=Path, help="file to write")
    args = parser.parse_args()
    check_args(args, trials=Count)
    if args.json:
        check_output(args.json)
    description, rng = Policy(args.export).description, np.random.default_rng(args.seed)
    if (name := description["robot"]["name"]) != "go2":
        raise UserError(f"the policy is of the robot '{name}'; only a 'go2' can be simulated over DDS")
    rate, domain = default_rate(description["timing"]["control_frequency"]), 2 + os.getpid() % 90
    side, (pipe, theirs) = Robot(resource_path(description["robot"]["file"]), domain), mp.Pipe()
    process = mp.get_context("spawn").Process(target=program, args=(args.export, domain, rate, theirs), daemon=True)
    process.start()
    theirs.close()  # so that its end is noticed
    rows: list[dict[str, Any]] = []
    stopped = in_a_row = 0
    try:
        with (
            StopRequest(lambda text: None) as stop,
            RealTimeLoop(RATE, side.tick) as loop,
            Counter("faults", args.trials) as counter,
        ):
            while len(rows) < args.trials and not stop.requested and loop.error is None:
                assert process.pid
                row = trial(KINDS[len(rows) % len(KINDS)], side, pipe, process.pid, rng)
                stopped, in_a_row = stopped + (row is None), 0 if row else in_a_row + 1
                if in_a_row == GIVE_UP:
                    raise UserError(f"{GIVE_UP} times in a row the robot was stopped before its fault")
                if row:
                    rows.append(row)
                    counter.add()
            pipe.send("end")
        process.join(10.0)
        if loop.error is not None:
            raise loop.error
    finally:
        side.side.close()
        result = {"policy": description["task"], "commands_per_s": rate, "stopped_before": stopped, "rows": rows}
        report(result, args.json)


def report(result: dict[str, Any], file: Path | None) -> None:
    """Print a table, and write a file if there is one."""
    rows = result["rows"]
    for kind in KINDS:
        of = [row for row in rows if row["fault"] == kind]
        times = sorted(row["ms"] or np.inf for row in of) or [np.nan]
        excess = max((row["excess"] for row in of), default=np.nan)
        print(f"{kind:22} {len(of):4}  {times[len(times) // 2]:5.1f}, at most {times[-1]:5.1f} ms  {excess:6.3g} N m")
    rate, stopped = result["commands_per_s"], result["stopped_before"]
    print(f"{stopped} times the robot was stopped before its fault, {len(rows)} faults, {rate:g} commands a second")
    if file:
        write_json(file, result | {"versions": package_versions()})


if __name__ == "__main__":
    run_script(main)
