"""The control of a robot, in step with a simulated one: what drives do, standing up, walking, faults of all kinds."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.control import JOINTS
from support.exports import export_random
from support.simulated import RATE, Simulated, World, robot_of, standing_at_once

from legged_torque import resource_path
from legged_torque.deploy.policy import Policy
from legged_torque.envs import task_registry
from legged_torque.runtime.brakes import Brakes, Joints, fault, limited, tilt_of
from legged_torque.runtime.chirp import Chirp
from legged_torque.runtime.controller import Controller, Mode
from legged_torque.runtime.interface import MotorCommand, Received, RobotState
from legged_torque.runtime.log import Log, RecordedLog
from legged_torque.runtime.sim_robot import Faults, InProcess, SimRobot
from legged_torque.utils.errors import UserError

ALLOWED = round(0.02 * RATE)  # ticks until a fault must have ended in damping
TRIALS = 5  # of each fault


def test_motors_and_latency():
    """A torque comes late by the latency and then rises as its lag says."""
    motors, lagging = task_registry.get_cfgs("a1_position")[0].motors, 0.01
    motors.chain, motors.lag.time_constant = ["ideal", "lag"], lagging
    names = [f"{name}_joint" for name in JOINTS]
    robot = SimRobot(resource_path("resources/robots/a1/a1.xml"), names, RATE, motors=motors, latency=0.006)
    zeros, seen, robot.data.qpos[2] = np.zeros(12), [], 1.0  # in free fall, nothing moves its joints
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


def fault_of(**changes):
    """The fault of a state in wide limits, but for these changes."""
    state, wide = random_state(np.random.default_rng(0)), np.array([[-99.0] * 12, [99.0] * 12])
    joints = Joints([f"joint {i}" for i in range(12)], wide, wide, wide[1])
    return fault(replace(state, **changes), 0.0, Received(), joints, Brakes())


def test_numbers_that_hide_others():
    """A robot does not walk on if no joint can be said to be the hottest, or to have an error."""
    assert fault_of() == ""
    numbers = np.where(np.arange(12) == 3, np.nan, np.where(np.arange(12) == 5, 130.0, 0.0))
    for name in ("temperatures", "errors"):
        assert fault_of(**{name: numbers}) == f"a measurement is not finite, of {name}"


def test_error_flags_of_other_types():
    """They may be negative or floats, as of a transport of one's own."""
    for error, said in ((-2.0, "-0x2"), (16, "0x10")):
        assert fault_of(errors=np.where(np.arange(12) == 3, error, 0)) == f"joint 3 has {said} as error flag"


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
    timing, motors = policy.description["timing"], policy.description["motors"]
    policy.description["timing"] = timing | {"refresh_torques": False}
    with pytest.raises(UserError, match="hold torques of position_residual"):
        Controller(policy, order, RATE)
    policy.description["timing"] |= {"decimation": 1}
    Controller(policy, order, RATE)
    policy.description["timing"] = timing
    policy.description["motors"] = {"own": {"model": "muscle"}, "ideal": {"model": "ideal"}}
    for call in (lambda: Controller(policy, order, RATE), lambda: policy.torques(*np.zeros((3, 12)))):
        with pytest.raises(UserError, match=r"gains of a motor 'drive' alone, not: the law of the motors' own$"):
            call()
    policy.description["motors"] = motors
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
        assert (world.controller.reason == "stopped by the operator") == (name == "operator")
        assert world.controller.reason == world.stops[-1] or name == "operator"
        assert not world.controller.sent.kp.any() and world.controller.sent.kd.all()
        if mend:
            mend()
        assert world.robot.excess <= 1e-6 or name in ("too fast", "beyond its range")  # under the command before
        world.robot.excess = 0.0


def test_why_it_was_stopped(policy):
    """The first reason stays until the robot stands up again, whatever the operator asks; an end has one, too."""
    world, said = standing_at_once(policy), "stopped by the operator"
    for asked, expected in (
        ([Mode.DAMPING, Mode.PASSIVE], ""),
        ([Mode.STAND], ""),
        ([Mode.PASSIVE, Mode.DAMPING], said),
        ([Mode.STAND], ""),
        ([Mode.STAND, Mode.POLICY], ""),
        ([Mode.DAMPING], said),
    ):
        for mode in asked:
            assert world.controller.request(mode) == ""
            assert world.run(10) == mode and world.controller.reason == expected
    world.controller.request(Mode.STAND)
    world.run(1)
    world.robot.faults.hot = ["FR_hip_joint"]
    assert world.run(1) == Mode.DAMPING and world.controller.request(Mode.DAMPING) == ""
    assert world.stops == [world.controller.reason] == ["FR_hip_joint has 120 deg C, too hot"]
    world.robot.faults.hot = []
    world.run(1)
    world.controller.request(Mode.STAND)
    world.run(1)
    world.close()
    assert world.controller.reason == "the program ends" and len(world.stops) == 1


def test_before_the_first_state(policy):
    """The reason distinguishes a silent robot from one whose messages are all damaged."""
    for faults, expected in ((Faults(silent=True), "not said anything"), (Faults(damaged=1.0), "messages are damaged")):
        world = World(policy)
        world.robot.faults = faults
        world.run(5)
        assert expected in world.controller.request(Mode.STAND) and world.controller.mode != Mode.STAND


def test_a_policy_takes_over_bit_by_bit(policy, monkeypatch):
    """From standing, torques become those of a policy that always says the same, evenly within half a second."""
    world, off, speed = standing_at_once(policy), np.linspace(-0.05, 0.05, 12), np.linspace(0.2, -0.2, 12)
    of_joint = [policy.joint_order.index(name) for name in world.robot.joint_order]
    kp, kd, nominal = (part[of_joint] for part in (policy.stiffness, policy.damping, policy.nominal_pose))
    position, torque = policy.description["actions"]["terms"]
    wanted = torque["mixing_weight"] * torque["scale"] * 1.5 - position["mixing_weight"] * (kp * off + kd * speed)
    assert wanted.min() > 4.0
    state = replace(world.controller.state, joint_positions=nominal + off, joint_velocities=speed)
    world._transport = SimpleNamespace(receive=lambda: Received(state), send=lambda command: None)
    answer = [np.repeat(np.float32([[0.0, 1.5]]), 12, axis=1)]  # no positions other than the nominal ones
    monkeypatch.setattr(policy, "session", SimpleNamespace(run=lambda *_: answer))
    for mode in (Mode.STAND, Mode.POLICY):
        assert world.controller.request(mode) == "" and world.run(0 if mode == Mode.POLICY else 50) == mode
    for tick in range(1, 301):
        world.run(1)
        share = min(tick / RATE / 0.5, 1.0)
        expected = (1.0 - share) * (-60.0 * off - 5.0 * speed) + share * wanted
        np.testing.assert_allclose(world.controller.sent.torques(nominal + off, speed), expected, atol=1e-4)
    assert world.controller.mode == Mode.POLICY


@pytest.mark.parametrize(("clip", "largest"), [(0.01, 100.0), (1.0, 100.0), (10.0, 1000.0), (75.0, 7500.0)])
def test_actions_out_of_range(policy, monkeypatch, clip, largest):
    """One joint's ends a walk by what it was before the clip, which leaves 300 N m at most; saturated ones do not."""
    monkeypatch.setattr(policy, "_action_clip", [-clip, clip])
    for number, mode in ((0.99 * largest, Mode.POLICY), (-1.01 * largest, Mode.DAMPING), (1e6, Mode.DAMPING)):
        world, answer = standing_at_once(policy), np.zeros((1, 24), np.float32)
        answer[0, 12 + policy.joint_order.index("RL_calf_joint")] = number
        monkeypatch.setattr(policy, "session", SimpleNamespace(run=lambda *_, answer=answer: [answer]))
        for asked in (Mode.STAND, Mode.POLICY):
            assert world.controller.request(asked) == ""
            end = world.run(10)
        said = f"the network's torque of RL_calf_joint is {number:.4g}, beyond {largest:g}"
        assert (end, world.stops) == (mode, [said] * (mode == Mode.DAMPING))


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
        assert world.run(1) == mode and not world.stops
        assert not world.robot._command.kp.any() and world.robot._command.kd.any() == damps
