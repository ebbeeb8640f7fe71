"""Logs of every tick: what was written is read, the policy does the same on it, and a simulated robot parts from it."""

import sys
from pathlib import Path
from resource import RLIMIT_FSIZE, getrlimit, setrlimit

import numpy as np
import pytest
from support.exports import export_random
from support.settings import error_of
from support.simulated import RATE, Simulated, robot_of

from legged_torque.deploy.policy import Policy
from legged_torque.runtime.controller import Controller, Mode
from legged_torque.runtime.interface import Received
from legged_torque.runtime.log import Log, RecordedLog
from legged_torque.runtime.replay import same_actions, simulate
from legged_torque.runtime.sim_robot import InProcess

STAND, WALK = 1700, 150  # ticks of each
DEAD = STAND + 60  # tick at which a motor dies


@pytest.fixture(scope="module")
def recorded(policy, tmp_path_factory):
    """A log of standing up and a policy, in which a motor dies; all that was said and sent; a copy of it not closed."""
    robot, folder = robot_of(policy), tmp_path_factory.mktemp("logs")
    wire, controller = InProcess(robot), Controller(policy, policy.joint_order, RATE)
    session, seen = Simulated(controller, wire, Log(folder / "log.mcap", controller)), []
    step = controller.step
    controller.step = lambda received, *args: (seen.append((received.newest, step(received, *args))), seen[-1][1])[1]
    for tick in range(STAND + WALK):
        if tick in (5, STAND):
            assert controller.request(Mode.STAND if tick == 5 else Mode.POLICY) == ""
        robot.faults.dead = ["RR_calf_joint"] if tick >= DEAD else []
        robot.faults.not_finite = tick == STAND + WALK - 3
        session.tick(tick / RATE, missed=tick == 7)
        session.log.write()
    (folder / "cut.mcap").write_bytes((folder / "log.mcap").read_bytes())
    session.log.close()
    return folder, seen


def test_what_was_written_is_read(policy, recorded):
    """States and commands are those of each tick, to the bit; so are the reasons of stops."""
    folder, seen = recorded
    log = RecordedLog(folder / "log.mcap")
    assert (log.joint_order, log.period) == (policy.joint_order, 1 / RATE)
    ticks = list(log.ticks())
    assert len(ticks) == len(seen) == STAND + WALK
    for number, ((time, state, command, rest), (said, sent)) in enumerate(zip(ticks, seen, strict=True)):
        assert time == pytest.approx(number / RATE) and rest["missed"] == (number == 7)
        for one, other in ((state, said), (command, sent)):
            for name, value in vars(other).items():
                assert np.array_equal(getattr(one, name), value, equal_nan=True)
    assert ticks[STAND + 5][3]["mode"] == "policy" and "finite" in ticks[-1][3]["reason"]
    cut = list(RecordedLog(folder / "cut.mcap").ticks())
    assert STAND < len(cut) < len(ticks) and cut[-1][0] == ticks[len(cut) - 1][0]


def test_times_and_problems_of_ticks(policy, tmp_path):
    """By how much each began after its time, for how long it took until its command was sent; what was wrong."""
    controller, wire = Controller(policy, policy.joint_order, RATE), InProcess(robot_of(policy))
    session, begins = Simulated(controller, wire, Log(tmp_path / "log.mcap", controller)), (7.0, 7.0025, 7.004, 7.0073)
    late = dict(zip(begins, (0.0, 5e-4, 0.0, 1.3e-3), strict=True))
    for begin, session.took in zip((*begins, 7.0093), (1e-4, 2e-4, 1.5e-3, 0.0, 3e-4), strict=True):
        receive = wire.receive
        if begin == 7.0025:
            wire.receive = lambda: Received(problems=["two programs send rt/lowstate"])
        session.tick(begin, begin == 7.0073, late.get(begin, 0.0))  # after which the next one is due a period later
        wire.receive = receive
    session.log.close()
    ticks = [rest for *_, rest in RecordedLog(tmp_path / "log.mcap").ticks()]
    np.testing.assert_allclose([rest["lateness"] for rest in ticks], [0.0, 5e-4, 0.0, 1.3e-3, 0.0], atol=1e-9)
    np.testing.assert_allclose([rest["took"] for rest in ticks], [1e-4, 2e-4, 1.5e-3, 0.0, 3e-4], atol=1e-9)
    assert [rest["problems"] for rest in ticks] == [[], ["two programs send rt/lowstate"], [], [], []]


def test_the_policy_does_the_same(policy, recorded, make_task, tmp_path):
    """Its actions are the same, bit by bit; another policy is refused."""
    log = RecordedLog(recorded[0] / "log.mcap")
    steps, equal = same_actions(log, policy)
    assert steps == equal == len(range(0, WALK - 3, 10))
    export_random(make_task, "a1_torque_multihead", tmp_path / "other", normalization=True)
    assert "another policy" in error_of(same_actions, log, Policy(tmp_path / "other"))


def test_where_they_part(policy, recorded):
    """A simulated robot under the same commands does the same, until a motor dies in the log."""
    log = RecordedLog(recorded[0] / "log.mcap")
    gap = simulate(log, robot_of(policy))
    before = gap.times <= DEAD / RATE
    assert np.array_equal(gap.simulated[before], gap.logged[before]) and not gap.rms(DEAD / RATE).any()
    parts = gap.parts_at(0.02)
    assert DEAD / RATE < parts.min() <= parts[policy.joint_order.index("RR_calf_joint")] < DEAD / RATE + 0.1


@pytest.mark.parametrize("keeps_time", [True, False])
def test_the_robot_goes_on_while_the_program_is_late(policy, tmp_path, keeps_time):
    """A simulated robot under the commands of a log does the same, whatever time lies between them."""
    robot = robot_of(policy)
    controller, ticks = Controller(policy, policy.joint_order, RATE), 0
    session = Simulated(controller, InProcess(robot), Log(tmp_path / "log.mcap", controller, keeps_time))
    for number in range(300):
        late = number % 100 // 99 * 4
        for _ in range(late * keeps_time):
            robot.step(Received())
        ticks += 1 + late
        session.tick(ticks / RATE, missed=late > 0)
        session.log.write()
        if number == 5:
            assert controller.request(Mode.STAND) == ""
    session.log.close()
    assert controller.mode == Mode.STAND
    gap = simulate(RecordedLog(tmp_path / "log.mcap"), robot_of(policy))
    assert len(gap.times) == 300 and np.ptp(gap.logged, axis=0).max() > 0.05
    np.testing.assert_allclose(gap.simulated, gap.logged, atol=1e-12)


def test_mistakes(policy, recorded, tmp_path, monkeypatch):
    """A file that exists, one that is no log or damaged, and missing packages: one line each."""
    controller = Controller(policy, policy.joint_order, RATE)
    assert "exists" in error_of(Log, recorded[0] / "log.mcap", controller)
    (tmp_path / "no.mcap").write_bytes(b"something else")
    assert "no log" in error_of(RecordedLog, tmp_path / "no.mcap")
    assert "cannot read" in error_of(RecordedLog, Path("nowhere.mcap"))
    content = bytearray((recorded[0] / "log.mcap").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(content)
    assert "damaged.mcap' is no log" in error_of(list, RecordedLog(tmp_path / "damaged.mcap").ticks())
    controller.period = 0.0
    Log(tmp_path / "still.mcap", controller).close()
    assert "its period is 0 s" in error_of(RecordedLog, tmp_path / "still.mcap")
    monkeypatch.delitem(sys.modules, "legged_torque.runtime.log")
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    assert "legged_torque[robot]" in error_of(__import__, "legged_torque.runtime.log")


@pytest.mark.skipif(sys.platform != "linux", reason="limits of file sizes")
def test_full_disk(policy, tmp_path):
    """The robot goes on without its log, which says so and can be read as far as it goes."""
    wire, controller = InProcess(robot_of(policy)), Controller(policy, policy.joint_order, RATE)
    session, limits = Simulated(controller, wire, Log(tmp_path / "log.mcap", controller)), getrlimit(RLIMIT_FSIZE)
    setrlimit(RLIMIT_FSIZE, (300_000, limits[1]))
    try:
        for tick in range(1000):
            session.tick(tick / RATE, missed=False)
            session.log.write()
            if tick == 5:
                controller.request(Mode.STAND)
        session.log.close()
    finally:
        setrlimit(RLIMIT_FSIZE, limits)
    assert controller.mode == Mode.STAND and "the log" in session.log.problem
    assert 100 < len(list(RecordedLog(tmp_path / "log.mcap").ticks())) < 1000
