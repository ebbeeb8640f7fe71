"""What the page shows besides the robot, against hand computations: ghost, lane, gait, contact forces, PD targets."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch

from legged_torque import resource_path
from legged_torque.viewer.lane import FARTHEST, SIDE, Lane, heading_of
from legged_torque.viewer.reading import Reading, TaskReader, watched

NOTHING = dict.fromkeys((field.name for field in dataclasses.fields(Reading)), np.zeros(0))
DT = 0.02


def pose(x=0.0, y=0.0, yaw=0.0):
    """A row of positions, with one joint at 0.7 rad."""
    return np.array([x, y, 0.3, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2), 0.7])


def steps_of(command, count, reset_after=0):
    """Readings of a robot that stays where it is, looking to +y; its episode starts anew after some steps."""
    pasts = []
    for number in range(count):
        values = {"qpos": pose(1.0, 2.0, math.pi / 2)[None], "commands": np.array([command]), "world": 0}
        age = np.array([number - reset_after if number >= reset_after else number])
        pasts.append(Reading(**{**NOTHING, "time": number * DT, "age": age, **values}))
    return pasts


def commanded_pose(*args):
    """That of the package, which needs the extra."""
    layers = pytest.importorskip("legged_torque.viewer.layers", reason="the extra 'viewer' is not installed")
    return layers.commanded_pose(*args)


def test_ghost_on_a_circle():
    """1 m/s and 1 rad/s for one second: an arc of radius 1 m over 1 rad, from where the robot stood, looking to +y."""
    ghost = commanded_pose(steps_of((1.0, 0.0, 1.0), 80), DT)
    assert ghost[:2] == pytest.approx([1.0 - (1.0 - math.cos(1.0)), 2.0 + math.sin(1.0)], abs=1e-3)
    assert heading_of(ghost) == pytest.approx(math.pi / 2 + 1.0, abs=1e-6)
    assert ghost[2] == 0.3 and ghost[7] == 0.7


@pytest.mark.parametrize(("count", "reset_after", "seconds"), [(1, 0, 0.0), (21, 0, 0.4), (80, 70, 0.18)])
def test_ghost_of_a_new_episode(count, reset_after, seconds):
    """It follows the commands from the start of the episode, and no further back than is known."""
    ghost = commanded_pose(steps_of((0.0, 0.5, 0.0), count, reset_after), DT)
    assert ghost[:2] == pytest.approx([1.0 - 0.5 * seconds, 2.0])  # its left is -x


def test_lane():
    """The second robot starts at the right of the first; its steps forward are steps along the first one's front."""
    lane, first = Lane(), pose(3.0, -1.0, math.pi / 2)
    placed = lane.place(first, pose(10.0, 10.0, math.pi))
    assert placed[:2] == pytest.approx([3.0 + SIDE, -1.0]) and heading_of(placed) == pytest.approx(math.pi / 2)
    placed = lane.place(first, pose(9.0, 10.0, math.pi + 0.2))  # 1 m ahead, and turned to the left
    assert placed[:2] == pytest.approx([3.0 + SIDE, 0.0]) and heading_of(placed) == pytest.approx(math.pi / 2 + 0.2)
    assert placed[2] == 0.3 and placed[7] == 0.7
    again = lane.place(first, pose(10.0 - FARTHEST - 1.0, 10.0, math.pi))
    assert again[:2] == pytest.approx([3.0 + SIDE, -1.0])  # too far away


def test_gait():
    """Dark from the step where a foot lands to the one where it lifts off, now at the right; shares of the time."""
    from legged_torque.viewer.bars import gait_html

    contacts = np.zeros((100, 2))
    contacts[20:70, 0] = contacts[90:, 0] = 1.0
    text = gait_html(["FR", "FL"], contacts, 5)
    assert 'd="M170 0V1H220V0zM240 0V1H250V0z"' in text and 'd=""' in text
    assert "60 %" in text and "0 %" in text and text.count('viewBox="0 0 250 1"') == 2


@pytest.fixture(scope="module")
def standing(make_task):
    """A watched robot that has stood for a second on the position task's nominal pose, its reader and readings."""
    task = make_task("a1_position", num_envs=2, **{"control.decimation": 1, "sim.dt": 0.005})
    env_cfg = task.cfg
    torch.manual_seed(1)
    task = watched(type(task))(env_cfg, "cpu")
    reader, readings = TaskReader(task), []
    for step in range(200):
        before = task.dof_pos[1].clone(), task.dof_vel[1].clone()
        reader.before_step()
        task.step(torch.full((2, 12), 0.01 * (step % 7)))
        readings.append(reader.read(0.0, 1))
    return task, readings, before


def test_contact_forces_carry_the_robot(standing):
    """On average, the ground pushes with the robot's weight, at the feet that are said to touch it."""
    task, readings, _ = standing
    mean = np.mean([reading.forces.sum(axis=0) for reading in readings[-100:]], axis=0)
    mass = mujoco.MjModel.from_xml_path(str(resource_path(task.cfg.asset.file))).body_mass.sum()
    assert mean[2] == pytest.approx(9.81 * mass, rel=0.05)
    last = readings[-1]
    forces = np.linalg.norm(last.forces[task.feet_indices.numpy()], axis=1)
    assert last.feet.tolist() == (forces > 0.0).astype(float).tolist() and last.feet.sum() >= 2
    assert last.age.tolist() == [200.0]


def test_targets_of_pd_control(standing):
    """The torque of the last physics step is that of a spring to the shown target and a damper."""
    task, readings, (position, velocity) = standing
    torque = task.p_gains[1] * (torch.from_numpy(readings[-1].targets) - position) - task.d_gains[1] * velocity
    expected = (torque * task.motor_strength[1]).clamp(*task.torque_limits)
    np.testing.assert_allclose(readings[-1].torques, expected.numpy(), atol=1e-3)


def test_no_targets_without_pd_control(make_task):
    """Torque control wants no positions."""
    task = make_task("a1_torque", num_envs=2)
    task = watched(type(task))(task.cfg, "cpu")
    assert TaskReader(task).read(0.0, 0).targets.shape == (0,)
