"""The control of a robot, in step with a simulated one: what drives do, standing up, walking, faults of all kinds."""

import signal
import subprocess
import sys
import time
from subprocess import PIPE
from types import SimpleNamespace

import numpy as np
import pytest
from support.control import JOINTS
from support.exports import export_random
from support.simulated import RATE, Simulated, World, robot_of, standing_at_once

from legged_torque import resource_path
from legged_torque.deploy.policy import Policy
from legged_torque.envs import task_registry
from legged_torque.runtime.brakes import Brakes, Joints, limited, tilt_of
from legged_torque.runtime.chirp import Chirp
from legged_torque.runtime.controller import Controller, Mode
from legged_torque.runtime.in_process import InProcess
from legged_torque.runtime.interface import MotorCommand, Received, RobotState
from legged_torque.runtime.log import Log, RecordedLog
from legged_torque.runtime.sim_robot import Faults, SimRobot
from legged_torque.utils.errors import UserError

ALLOWED = round(0.02 * RATE)  # ticks until a fault must have ended in damping
TRIALS = 5  # of each fault


def test_motors_and_latency():
    """A torque comes late by the latency and then rises as its lag says."""
    motors, lagging = task_registry.get_cfgs("a1_position")[0].motors, 0.01
    motors.chain, motors.lag.time_constant = ["ideal", "lag"], lagging
    names = [f"{name}_joint" for name in JOINTS]
    robot = SimRobot(resource_path("resources/robots/a1/a1.xml"), names, RATE, motors=motors, latency=0.006)
    zeros, seen = np.zeros(12), []
    command = Received(MotorCommand(zeros + 3.0, zeros, zeros, zeros, zeros))
    for _ in range(10):
        robot.step(command)
        seen.append(robot.says()[0].joint_torques.copy())
    steps = np.arange(2, 21, 2) - 6.0  # of 1 ms since the torque has arrived
    expected = 3.0 * (1.0 - np.exp(-np.maximum(steps, 0.0) * 1e-3 / lagging))
    np.testing.assert_allclose(seen, np.repeat(expected[:, None], 12, axis=1), atol=1e-5)


def test_drives_get_their_gains_by_commands():
    """A robot with the motors of a policy that damps moves like one without: the commands bring the damping."""
    motors, at = task_registry.get_cfgs("a1_torque_damped")[0].motors, []
    motors.drive.stiffness = 5.0
    for own in (motors, None):
        robot = SimRobot(resource_path("resources/robots/a1/a1.xml"), [f"{n}_joint" for n in JOINTS], RATE, motors=own)
        for _ in range(20):
            robot.step(Received(MotorCommand(*np.zeros((4, 12)), np.full(12, 0.5))))
        at.append(robot.data.qpos.copy())
    assert np.array_equal(*at)


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_the_end_comes_whatever_fails(policy, tmp_path, error):
    """A transport that can no longer send, or Ctrl-C, ends neither the farewell nor the log before its time."""
    world, failing = World(policy), iter([error])
    log = Log(tmp_path / "log.mcap", world.controller)
    session = Simulated(world.controller, InProcess(world.robot), log)
    session.tick(0.0, missed=False)
    session._transport.send = lambda command: [(_ for _ in ()).throw(each) for each in failing]
    with pytest.raises(error):
        session.close()
    assert len(list(RecordedLog(tmp_path / "log.mcap").ticks())) > 2


@pytest.mark.parametrize("walks", [False, True])
def test_a_transport_that_receives_no_more(policy, walks):
    """The robot is told to damp in that very tick, and at the end, which comes without an error."""
    world = standing_at_once(policy)
    for mode in (Mode.STAND, Mode.POLICY)[: 1 + walks]:
        assert world.controller.request(mode) == ""
        world.run(20)
    assert world.robot._command.kp.any()
    world._transport.receive = lambda: {}["state"]
    assert world.run(1) == Mode.DAMPING and world.stops == ["KeyError: 'state'"]
    assert world.controller.request(Mode.STAND) == world.stops[0]
    world._transport.send = (sent := []).append
    world.close()
    assert len(sent) > 5
    for command in (world.robot._command, *sent):
        assert not command.kp.any() and not command.tau.any() and command.kd.all()


def random_state(rng, joints=12):
    """A state of a robot that stands, with joints anywhere near."""
    q, dq, zeros = rng.normal(0.0, 0.5, joints), rng.normal(0.0, 5.0, joints), np.zeros(joints)
    return RobotState(1, np.array([1.0, 0, 0, 0]), np.zeros(3), q, dq, zeros, zeros, zeros.astype(int))


@pytest.mark.parametrize(("stiffness", "damping"), [(0.0, 0.0), (7.0, 0.5)])
def test_drives_do_what_the_policy_wants(make_task, tmp_path, stiffness, damping):
    """Feed-forward torques and gains give in any state the torques of the policy's law and of a drive behind it."""
    drive = {"motors.chain": ["delay", "drive", "ideal"]}
    drive |= {"motors.drive.stiffness": {"calf": stiffness, "": 0.0}, "motors.drive.damping": damping}
    export_random(make_task, "go2_torque_multihead", tmp_path, **drive)
    policy, rng = Policy(tmp_path), np.random.default_rng(0)
    for _ in range(20):
        actions, state = rng.normal(0.0, 2.0, 24).astype(np.float32), random_state(rng)
        expected = policy.wanted_torques(actions, state.joint_positions, state.joint_velocities)
        held = stiffness * np.tile([0.0, 0.0, 1.0], 4)
        expected += held * (policy.nominal_pose - state.joint_positions) - damping * state.joint_velocities
        within = np.clip(expected, *policy.torque_limits)
        torques = policy.torques(actions, state.joint_positions, state.joint_velocities)
        np.testing.assert_allclose(torques, within, rtol=1e-4, atol=1e-4)
        tau, q, kp, kd = policy.drive_targets(actions)
        command = MotorCommand(tau, q, np.zeros(12), kp, kd)
        np.testing.assert_allclose(
            command.torques(state.joint_positions, state.joint_velocities), expected, rtol=1e-4, atol=1e-4
        )


def test_torques_stay_within_limits_and_change_slowly():
    """Whatever is asked for; within both, nothing changes."""
    rng = np.random.default_rng(0)
    limits = np.array([[-20.0] * 12, [30.0] * 12])
    joints = Joints([f"joint {i}" for i in range(12)], limits, 100 * limits, limits[1])
    for scale in (1.0, 1e2, 1e4):
        for _ in range(20):
            state, before = random_state(rng), rng.uniform(*limits)
            command = MotorCommand(*(scale * rng.normal(size=12) for _ in range(5)))
            at = (state.joint_positions, state.joint_velocities)
            result = limited(command, state, before, 4.0, joints).torques(*at)
            tolerance = 1e-9 * scale**2 * 100
            assert (result >= limits[0] - tolerance).all() and (result <= limits[1] + tolerance).all()
            assert (np.abs(result - before) <= 4.0 + tolerance).all()
            asked = command.torques(*at)
            is_allowed = (np.abs(asked - before) < 4.0) & (asked > limits[0]) & (asked < limits[1])
            np.testing.assert_allclose(result[is_allowed], asked[is_allowed], rtol=1e-9)


def test_tilt():
    """Turned by some angle about any level axis, and about the vertical one."""
    for angle in (0.0, 0.3, 1.0, 2.5):
        half, axis = angle / 2.0, np.array([0.6, 0.8, 0.0])
        rolled = np.array([np.cos(half), *(np.sin(half) * axis)])
        assert tilt_of(rolled) == pytest.approx(angle, abs=1e-6)
        assert tilt_of(np.array([np.cos(half), 0.0, 0.0, np.sin(half)])) == pytest.approx(0.0, abs=1e-6)


def test_from_lying_to_walking_and_back(policy):
    """A robot stands up into the nominal pose, hands over to the policy only then, and lies down in damping."""
    world = World(policy)
    assert world.run(10) == Mode.DAMPING
    assert "stands" in world.controller.request(Mode.POLICY)
    world.stand()
    joints, trunk = world.robot.data.qpos[7:], world.robot.data.qpos[2]
    nominal = [policy.description["nominal_pose"][name] for name in policy.joint_order]
    order = [world.robot.model.joint(i).name for i in range(1, 13)]
    nominal = np.array([nominal[policy.joint_order.index(name)] for name in order])
    assert np.abs(joints - nominal).max() < 0.2
    assert trunk > 0.25 and world.robot.excess <= 1e-6
    assert world.controller.request(Mode.POLICY) == "" and world.run(25) == Mode.POLICY
    assert world.controller.request(Mode.DAMPING) == ""
    assert world.run(round(3 * RATE)) == Mode.DAMPING and world.robot.data.qpos[2] < 0.2
    assert not world.controller.sent.kp.any() and not world.controller.sent.tau.any()
    world.robot.faults.dead, world.controller.brakes.stand_up = order, 0.01  # time passes, and nothing moves
    assert world.controller.request(Mode.STAND) == "" and world.run(10) == Mode.STAND
    worst = np.abs(joints - nominal).argmax()
    refused = f"{order[worst]} is {abs(joints - nominal)[worst]:.2f} rad from the nominal pose, at most 0.5 are allowed"
    assert world.controller.request(Mode.POLICY) == refused


def test_the_wrong_robot(policy):
    """Joints that one does not know, exports without ranges or speeds, and rates that do not fit are refused."""
    order = policy.joint_order
    for wrong in (order[:-1], [*order, "tail"], ["FR_hp_joint", *order[1:]]):
        with pytest.raises(UserError, match="joint"):
            Controller(policy, wrong, RATE)
    with pytest.raises(UserError, match="multiple of the policy's 50 Hz"):
        Controller(policy, order, 490.0)
    for lacking in ("range", "max_velocity"):
        had = policy.description["joints"][order[3]].pop(lacking)
        for wrong in (policy, Chirp(policy, RATE, 10.0)):
            with pytest.raises(UserError, match="export the policy anew"):
                Controller(wrong, order, RATE)
        policy.description["joints"][order[3]][lacking] = had
    timing = policy.description["timing"]
    policy.description["timing"] = timing | {"refresh_torques": False}
    with pytest.raises(UserError, match="hold torques of position_residual"):
        Controller(policy, order, RATE)
    policy.description["timing"] |= {"decimation": 1}
    Controller(policy, order, RATE)
    policy.description["timing"] = timing
    policy.supplied = ["felt"]
    with pytest.raises(UserError, match="observes felt"):
        Controller(policy, order, RATE)
    policy.supplied = []
    with pytest.raises(UserError, match="no 'left_knee_joint'"):
        SimRobot(resource_path("resources/robots/g1/g1.xml"), ["left_hip_yaw_joint", "left_knee_joint"], RATE)


def turned(world):
    """Lay the robot on its side."""
    world.robot.data.qpos[3:7] = [np.cos(0.7), np.sin(0.7), 0.0, 0.0]


def says(number):
    """Let the network say this number."""

    def inject(world):
        session = world.controller.policy.session
        answer = [np.full((1, 24), number, np.float32)]
        world.controller.policy.session = type("Broken", (), {"run": lambda *_: answer})()
        return lambda: setattr(world.controller.policy, "session", session)

    return inject


FAULTS = {
    "silent": lambda world: setattr(world.robot.faults, "silent", True),
    "late": lambda world: setattr(world.robot.faults, "delay", 0.1),
    "damaged": lambda world: setattr(world.robot.faults, "damaged", 1.0),
    "not finite": lambda world: setattr(world.robot.faults, "not_finite", True),
    "no orientation": lambda world: world.robot.data.qpos.__setitem__(slice(3, 7), 0.0),
    "hot": lambda world: world.robot.faults.hot.append("RR_calf_joint"),
    "error flag": lambda world: world.robot.faults.error.append("FL_hip_joint"),
    "tilted": turned,
    "too fast": lambda world: world.robot.data.qvel.__setitem__(slice(6, 9), 200.0),
    "beyond its range": lambda world: world.robot.data.qpos.__setitem__(9, 0.6),
    "network, not finite": says(np.nan),
    "network, out of range": says(1e6),
    "program": lambda world: setattr(world.controller.brakes, "max_tilt", "a mistake in the program"),
    "operator": lambda world: world.controller.request(Mode.DAMPING) and None,
}


@pytest.mark.parametrize("rate", [300.0, 400.0, 450.0, 2000.0])
def test_time_passes_for_the_robot(policy, rate):
    """As for the program, however many commands a second it sends: its physics divide their time evenly."""
    robot = robot_of(policy, rate=rate)
    for _ in range(60):
        robot.step(Received())
    assert robot.data.time == pytest.approx(60 / rate)


def test_every_fault_ends_in_damping(policy):
    """At random moments of standing and walking, within 20 ms, without a torque beyond limits on the robot's side."""
    rng, world = np.random.default_rng(0), World(policy, Brakes(stand_up=0.02))
    qpos = World(policy).stand().robot.data.qpos.copy()
    for trial in range(TRIALS * len(FAULTS)):
        name = list(FAULTS)[trial % len(FAULTS)]
        world.robot.faults, world.controller.brakes.max_tilt = Faults(), Brakes.max_tilt
        world.run(60)  # until all that was late has come
        world.robot.data.qpos[:], world.robot.data.qvel[:] = qpos, 0.0
        world.run(2)
        assert world.controller.request(Mode.STAND) == "", name
        assert world.run(15) == Mode.STAND
        if walks := "network" in name or rng.random() < 0.5:
            assert world.controller.request(Mode.POLICY) == ""
        assert world.run(int(rng.integers(1, 12))) == (Mode.POLICY if walks else Mode.STAND), name
        mend = FAULTS[name](world)
        assert world.run(ALLOWED) == Mode.DAMPING, name
        assert world.controller.reason or name == "operator"
        assert not world.controller.sent.kp.any() and world.controller.sent.kd.all()
        if mend:
            mend()
    assert world.robot.excess <= 1e-6


def test_commands_that_are_late_are_not_sent(policy):
    """A tick that takes long, or the second of two that are late, tells the robot to damp instead."""
    world = World(policy).stand()
    for missed, in_time in ((False, 0.013), (True, 0.005)):
        for took, mode in ((in_time, Mode.STAND), (in_time + 0.002, Mode.DAMPING)):
            world.took = 0.0
            world.run(1)
            assert world.controller.request(Mode.STAND) == ""
            world.took = took
            assert world.run(1, missed) == mode
            assert world.robot._command.kp.any() == (mode == Mode.STAND)  # what has come


def test_the_operator_asks_before_a_command_is_sent(policy):
    """The command that has been decided is not sent any more."""
    for mode, damps in ((Mode.DAMPING, True), (Mode.PASSIVE, False)):
        world = standing_at_once(policy)
        assert world.controller.request(Mode.STAND) == ""
        world.run(10)
        assert world.robot._command.kp.all()
        world._clock = lambda world=world, mode=mode: world.controller.request(mode) or world.now  # then it is sent
        assert world.run(1) == mode
        assert not world.robot._command.kp.any() and world.robot._command.kd.any() == damps


def test_a_halt_between_two_ticks_is_noticed():
    """The operating system may halt the program while it waits for its next tick."""
    code = "import sys; from legged_torque.runtime.loop import RealTimeLoop; ticks = []\n"
    code += "with RealTimeLoop(20.0, lambda *tick: ticks.append(tick)):\n"
    code += "    print('ready', flush=True); sys.stdin.readline()\n"
    code += "print(*(f'{now} {missed:d}' for now, missed in ticks), sep='\\n')"
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
