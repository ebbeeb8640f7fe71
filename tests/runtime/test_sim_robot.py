"""The simulated robot: motors as a file says them, and what it refuses."""

import numpy as np
import pytest
from support.robot_files import changed as changed  # a fixture
from support.robot_files import setting
from support.settings import error_of
from support.simulated import RATE

from legged_torque.envs import task_registry
from legged_torque.runtime.interface import JOINT_ORDER, MotorCommand, Received
from legged_torque.runtime.sim_robot import SimRobot


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
