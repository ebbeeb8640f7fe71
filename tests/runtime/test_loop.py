"""The time of ticks: those that are late are noticed, end a walk if there are many, and are noted in the log."""

import signal
import subprocess
import sys
import time
from subprocess import PIPE
from types import SimpleNamespace

import numpy as np
from support.simulated import RATE, World, robot_of, standing_at_once

from legged_torque.runtime.brakes import Brakes
from legged_torque.runtime.controller import Controller, Mode
from legged_torque.runtime.interface import Received
from legged_torque.runtime.log import Log, RecordedLog
from legged_torque.runtime.loop import BIN, RealTimeLoop
from legged_torque.runtime.session import Session
from legged_torque.runtime.sim_robot import InProcess

ALLOWED = round(0.02 * RATE)  # ticks until a robot without commands must damp itself


def test_lateness_is_that_of_the_loop(policy, tmp_path):
    """In real time, with ticks that miss their deadlines, and others."""
    controller, wire = Controller(policy, policy.joint_order, RATE), InProcess(robot_of(policy))
    session = Session(controller, wire, Log(tmp_path / "log.mcap", controller))

    def tick(*about):
        session.tick(*about)
        time.sleep(0.0035 if loop.ticks % 7 == 0 else 0.0)

    with RealTimeLoop(RATE, tick) as loop:
        time.sleep(0.3)
    session.close()
    late = [rest["lateness"] for *_, rest in RecordedLog(tmp_path / "log.mcap").ticks()]
    assert len(late) > loop.ticks > 50
    for share in (0.5, 0.8, 0.95):
        of_log = np.sort(late[: loop.ticks])[int(np.ceil(share * loop.ticks)) - 1]
        assert loop.lateness(share) - 3 * BIN < of_log < loop.lateness(share) + BIN
    assert max(late[loop.ticks :]) < 0.2  # of the farewell, which has no loop


def test_a_halt_between_two_ticks_is_noticed():
    """The operating system may halt the program while it waits for its next tick."""
    code = "import sys; from legged_torque.runtime.loop import RealTimeLoop; ticks = []\n"
    code += "with RealTimeLoop(20.0, lambda *tick: ticks.append(tick)):\n"
    code += "    print('ready', flush=True); sys.stdin.readline()\n"
    code += "print(*(f'{now} {missed:d}' for now, missed, _ in ticks), sep='\\n')"
    with subprocess.Popen([sys.executable, "-c", code], stdin=PIPE, stdout=PIPE, text=True) as program:
        assert program.stdout.readline() == "ready\n"
        time.sleep(0.3)
        program.send_signal(signal.SIGSTOP)
        time.sleep(0.5)
        program.send_signal(signal.SIGCONT)
        time.sleep(0.2)
        ticks = np.array([line.split() for line in program.communicate("\n")[0].splitlines()], float)
    longest = np.diff(ticks[:, 0]).argmax()
    assert ticks[longest + 1, 0] - ticks[longest, 0] > 0.4 and ticks[longest + 1, 1] and not ticks[0, 1]


def paced(world, durations):
    """Seconds until the robot is stopped, in a loop with absolute deadlines whose ticks take so long [s], or None."""
    begin = due = start = world.now + 1 / RATE
    for world.took in durations:
        world.tick(begin, missed := begin - due > 0.5 / RATE)
        if world.stops:
            return begin - start
        due = (begin if missed else due) + 1 / RATE
        begin = max(begin + world.took, due)
    return None


def test_a_program_that_is_late_again_and_again(policy):
    """It is stopped though half or most of its ticks are in time; one on a machine that is busy now and then is not."""
    busy = np.random.default_rng(0).uniform(3e-4, 0.0019, 4000)
    busy[::500], busy[1000::1500] = 0.0026, 0.01  # 0.6 and 8 ms late
    for durations, most in (
        (np.tile([0.011, 5e-4], 100), 0.05),
        (np.full(1000, 0.00227), 0.5),  # 88% of the rate
        (np.tile([*[0.00295] * 2, *[0.0015] * 8], 100), 0.5),
        (busy, None),
        (np.array([0.0135, *[5e-4] * 300] * 3), None),
    ):
        world, kept = standing_at_once(policy), Received(standing_at_once(policy).controller.state)
        assert world.controller.request(Mode.STAND) == ""
        world._transport = SimpleNamespace(receive=lambda kept=kept: kept, send=lambda command: None)
        ended = paced(world, durations)
        assert ended is most or (0.02 < ended < most and "late ticks have cost 2" in world.stops[0]), world.stops


def test_missed_deadlines_and_a_dead_program(policy):
    """A program that is late damps; one that says nothing more leaves a robot that damps itself."""
    world = World(policy).stand()
    assert world.run(round(RATE * Brakes.max_slow), missed=True) == Mode.STAND
    assert world.run(1, missed=True) == Mode.DAMPING
    assert world.controller.reason == "all deadlines of 10 ms were missed"
    for late, mode in ((6, Mode.STAND), (7, Mode.DAMPING)):  # ticks in which the program was halted
        world.run(1)
        assert world.controller.request(Mode.STAND) == ""
        world.ticks += late
        assert world.run(1, missed=True) == mode
    assert world.controller.reason == "all deadlines of 16 ms were missed"
    world.run(1)
    assert not world.robot.is_damping
    for _ in range(ALLOWED - 1):
        world.robot.step(Received())
    assert world.robot.is_damping and world.robot.watchdog_ticks
