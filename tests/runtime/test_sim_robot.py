"""The simulated robot: motors as a file says them, where it begins, what its drives ask for, and what it refuses."""

import mujoco
import numpy as np
import pytest
from support.robot_files import changed as changed  # a fixture
from support.robot_files import setting
from support.settings import error_of
from support.simulated import RATE

from legged_torque.envs import task_registry
from legged_torque.runtime.interface import JOINT_ORDER, MotorCommand, Received
from legged_torque.runtime.sim_robot import Faults, SimRobot


def moves(file):
    """Where a robot is after some steps of 3 N m on all joints, and the limits of its motors."""
    robot, zeros = SimRobot(file, JOINT_ORDER, RATE), np.zeros(12)
    for _ in range(5):
        robot.step(Received(MotorCommand(zeros + 3.0, zeros, zeros, zeros, zeros)))
    return robot.data.qpos.copy(), robot.limits


@pytest.mark.parametrize("attributes", [{"ctrlrange": None}, {"gear": "2", "forcerange": "-16.75 16.75"}])
def test_motors_of_a_file(changed, attributes):
    """Any gear and kind of limit: the same torques on the joints."""
    expected, limits = moves(changed())
    place, same = moves(changed(setting(".//default[@class='a1']/motor", **attributes)))
    np.testing.assert_allclose(place, expected, atol=1e-9)
    assert np.array_equal(same, limits)


def test_refused(changed):
    """A joint that the file lacks, and motors that need the gains of a robot."""
    assert "'tail_hip'" in error_of(SimRobot, changed(), [*JOINT_ORDER, "tail_hip"], RATE)
    motors = task_registry.get_cfgs("a1_position")[0].motors
    motors.chain, motors.network.layers = ["network", "ideal"], np.zeros((1, 1, 7)).tolist()
    assert "a motor network" in error_of(SimRobot, changed(), JOINT_ORDER, RATE, motors)


def test_begins_on_the_ground(changed):
    """In any pose, the lowest part just touches it: one millimetre further down it is that deep in it."""
    robot, tilted = SimRobot(changed(), JOINT_ORDER, RATE), np.array([np.cos(0.2), np.sin(0.2), 0.0, 0.0])
    for words in ((), (np.tile([0.0, 0.8, -1.5], 4),), (np.tile([0.0, 0.8, -1.5], 4), tilted)):
        robot.lie_down(*words)
        robot.data.qpos[2] -= 1e-3
        mujoco.mj_forward(robot.model, robot.data)
        assert robot.data.contact.dist.min() == pytest.approx(-1e-3, abs=1e-6)


def test_encoders(changed):
    """What the robot says, and what its drives make of it, are multiples of their resolutions."""
    motors, rng = task_registry.get_cfgs("a1_position")[0].motors, np.random.default_rng(0)
    motors.chain, encoder = ["encoder", "ideal"], motors.encoder
    encoder.position_resolution, encoder.velocity_resolution = 0.05, 0.5
    robot, zeros = SimRobot(changed(), JOINT_ORDER, 1000.0, motors), np.zeros(12)
    robot.data.qvel[6:] = rng.normal(0.0, 2.0, 12)
    for _ in range(20):
        pos, vel = 0.05 * np.round(robot.data.qpos[7:] / 0.05), 0.5 * np.round(robot.data.qvel[6:] / 0.5)
        said = robot.says()[0]
        np.testing.assert_allclose(said.joint_positions, pos, atol=1e-5)
        np.testing.assert_allclose(said.joint_velocities, vel, atol=1e-5)
        robot.step(Received(MotorCommand(zeros, zeros + 0.1, zeros, zeros + 5.0, zeros + 0.5)))
        np.testing.assert_allclose(robot.says()[0].joint_torques, 5.0 * (0.1 - pos) - 0.5 * vel, atol=1e-4)


def test_push(changed):
    """A robot in free flight goes on faster by that much, from the moment of the push."""
    pushed, other = robots = [SimRobot(changed(), JOINT_ORDER, RATE) for _ in range(2)]
    faults, apart = Faults(push=0.8), []
    for robot in robots:
        robot.data.qpos[2] = 5.0
    for tick in range(20):
        if tick >= 10:
            pushed.faults = faults
        for robot in robots:
            robot.step(Received())
        apart.append(pushed.data.qpos[:3] - other.data.qpos[:3])
    expected = 0.8 / RATE * np.maximum(np.arange(20) - 9, 0)
    np.testing.assert_allclose(np.linalg.norm(apart, axis=1), expected, atol=1e-9)
    np.testing.assert_allclose(np.array(apart)[:, 2], 0.0, atol=1e-9)


def test_watchdog(changed):
    """A command acts for 15 ms from its arrival on; once they are over, nothing acts before the next one arrives."""
    robot, zeros, driven = SimRobot(changed(), JOINT_ORDER, RATE, latency=0.1), np.zeros(12), []
    for tick in range(160):
        sent = {0: 3.0, 100: 0.0}  # N m by tick
        commands = [MotorCommand(zeros + sent[tick], zeros, zeros, zeros, zeros)] if tick in sent else []
        robot.step(Received(*commands))
        driven += [] if robot.is_damping else [tick]
    assert driven == [*range(50, 58), *range(150, 158)]  # of 2 ms


def test_torques_beyond_limits_between_two_commands(changed):
    """A command that asks for nothing when it arrives may ask for too much before the next one."""
    robot, zeros = SimRobot(changed(), JOINT_ORDER, RATE), np.zeros(12)
    robot.data.qpos[2], robot.data.qvel[6] = 5.0, 20.0
    robot.step(Received(MotorCommand(zeros, robot.data.qpos[7:].copy(), zeros, zeros + 2500.0, zeros)))
    assert robot.excess == pytest.approx(2500.0 * 20.0 * 1e-3 - robot.limits[1, 0], rel=0.05)
