"""The motion that drives are identified from, with the brakes of any policy."""

import io

import numpy as np
import pytest
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of
from support.simulated import Simulated

from legged_torque import resource_path
from legged_torque.deploy.policy import Policy
from legged_torque.identification.recording import read_recording
from legged_torque.runtime import chirp
from legged_torque.runtime.controller import Controller, Mode
from legged_torque.runtime.log import Log, RecordedLog
from legged_torque.runtime.sim_robot import InProcess, SimRobot

RATE, SECONDS = 500.0, 6.0


@pytest.fixture
def policy(exported_go2):
    """The policy."""
    return Policy(exported_go2)


def test_targets(policy):
    """They begin and end at the nominal pose, and stay within shares of ranges, speeds and torques."""
    sweeps = chirp.Chirp(policy, RATE, SECONDS)
    targets = np.array([sweeps.act(sweeps.observation(None, None)) for _ in range(round(SECONDS * RATE) + 1)])
    assert sweeps.has_ended and not targets[[0, -1]].any() and (np.abs(targets).max(axis=0) > 0.2).all()
    joints = [policy.description["joints"][name] for name in policy.joint_order]
    room = np.abs(np.array([joint["range"] for joint in joints]).T - policy.nominal_pose).min(axis=0)
    assert (np.abs(targets).max(axis=0) <= np.minimum(0.25, 0.5 * room) + 1e-6).all()
    speeds = np.diff(targets, axis=0) * RATE
    assert (np.abs(speeds).max(axis=0) < 0.3 * np.array([joint["max_velocity"] for joint in joints])).all()
    torques = policy.stiffness * targets[1:] - policy.damping * speeds
    assert (np.abs(torques).max(axis=0) < 0.6 * policy.torque_limits[1]).all()
    crossings = (targets[1:, 0] * targets[:-1, 0] < 0.0).sum()
    assert crossings == pytest.approx(2 * 5.05 * SECONDS, abs=3)  # two per turn, 5.05 Hz on average


def test_hanging_robot(exported_go2, policy, tmp_path):
    """A simulated robot goes through all of it without a fault, its trunk at rest; the log is for identify.py.

    Another one, which replay.py hangs up as tilted as that, does the same wherever the log has a state.
    """
    sweeps = chirp.Chirp(policy, RATE, SECONDS)
    robot = SimRobot(resource_path(policy.description["robot"]["file"]), policy.joint_order, RATE, hangs=True)
    robot.data.qpos[3:7] = [np.cos(0.2), 0.0, np.sin(0.2), 0.0]
    controller = Controller(sweeps, policy.joint_order, RATE)
    session = Simulated(controller, InProcess(robot), Log(tmp_path / "log.mcap", controller))
    for tick in range(1700 + round(SECONDS * RATE) + 1):
        session.tick(tick / RATE, missed=False)
        robot.faults.lost = 0.05 * (tick > 5)
        if tick in (5, 1700):
            assert controller.request(Mode.STAND if tick == 5 else Mode.POLICY) == ""
            before = robot.data.qpos[:7].copy()
    session.log.close()
    assert (controller.mode, session.stops, robot.excess) == (Mode.POLICY, [], 0.0)
    np.testing.assert_allclose(robot.data.qpos[:7], before, atol=0.01)
    measured = read_recording(RecordedLog(tmp_path / "log.mcap")).measured
    moved = np.nanmax(measured[:, 0], axis=0) - np.nanmin(measured[:, 0], axis=0)
    assert len(measured) == SECONDS * RATE and (moved > 0.3).all()
    assert np.isnan(measured[:, 0, 0]).mean() == pytest.approx(0.05, abs=0.02)
    status, said, _ = run_here("replay.py", "log.mcap", f"--policy={exported_go2}", root=tmp_path)
    assert status == 0 and said.count("never; 0.0000") == 12 and "bit by bit" not in said
    sweeps.description["task"] = "a1_position"
    Log(tmp_path / "other.mcap", controller).close()
    refused = run_here("replay.py", "other.mcap", f"--policy={exported_go2}", root=tmp_path)
    assert_told_in_one_line(refused, "the log is of the task 'a1_position', the policy of 'go2_torque_multihead'")


class Terminal(io.StringIO):
    """What somebody types."""

    def isatty(self):
        return True


def test_refused(policy, monkeypatch):
    """Nobody who can say that the robot hangs, another answer, and a policy without gains."""
    assert "needs a terminal" in error_of(chirp.confirm)
    for answer in ("it stands\n", ""):  # the end, as of Ctrl-D
        monkeypatch.setattr("sys.stdin", Terminal(answer))
        assert "robots that hang" in error_of(chirp.confirm)
    monkeypatch.setattr("sys.stdin", Terminal("it hangs\n"))
    chirp.confirm()
    monkeypatch.setattr(policy, "stiffness", 0.0 * policy.stiffness)
    assert "stiffness above 0" in error_of(chirp.Chirp, policy, RATE, SECONDS)


def test_torques_that_are_not_refreshed(policy, monkeypatch):
    """Those of the policy are held, sweeps act at every tick."""
    monkeypatch.setitem(policy.description["timing"], "refresh_torques", False)
    Controller(chirp.Chirp(policy, RATE, SECONDS), policy.joint_order, RATE)


def test_slow_rates(policy):
    """At the lowest one, targets move in steps that are small against the motion; lower ones are refused."""
    for rate in (4.0, 25.0, 99.0):
        said = f"--rate must be at least 100 for the 10 Hz of --chirp, not {rate:g}"
        assert error_of(chirp.Chirp, policy, rate, SECONDS) == said
    sweeps = chirp.Chirp(policy, 100.0, SECONDS)
    targets = np.array([sweeps.act(sweeps.observation(None, None)) for _ in range(round(SECONDS * 100.0))])
    assert np.abs(np.diff(targets, axis=0)).max() < 0.1 < 0.4 < np.ptp(targets)
