"""What viewers show, against hand computations: parts of torques, forces, PD targets, ghost and companion."""

import math

import numpy as np
import pytest
import torch
from support.sessions import tilted

from legged_torque.envs import task_registry
from legged_torque.viewer.snapshot import watched

NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")


def make_watched(make_task, name, **settings):
    """A watched task of two worlds."""
    task = make_task(name, num_envs=2, **settings)
    torch.manual_seed(1)
    return watched(type(task))(task.cfg, "cpu")


@pytest.mark.parametrize(("name", "parts"), [("a1_position", 0), ("a1_torque", 0), ("a1_torque_multihead", 2)])
def test_torque_parts(make_task, name, parts):
    """The parts of weighted action terms sum to the torque. Without weights there are none, without PD no targets."""
    task = make_watched(make_task, name)
    task.motors.strength.fill_(0.9)
    for _ in range(3):
        task.step(torch.randn(2, task.num_actions))
    snapshot = task.snapshot(0.0, 0)
    assert snapshot.torque_parts.shape == (parts, 12)
    assert snapshot.targets.shape == (0 if name == "a1_torque" else 12,)
    if parts:
        low, high = task.torque_limits.numpy()
        pd, direct = snapshot.torque_parts
        np.testing.assert_allclose(np.clip(pd + direct, low, high), snapshot.torques, rtol=1e-5, atol=1e-5)
        assert np.any(pd) and np.any(direct)
        expected = 0.9 * task.mixing[1] * task.torque_scale[0] * task.actions[0, 12:]
        np.testing.assert_allclose(direct, expected.numpy(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=NEEDS_GPU)])
def test_watching_changes_nothing(device):
    """A watched task does what the task does (bits on a CPU), and its parts are right in a CUDA graph too."""
    task_class = task_registry.get_task_class("a1_torque_multihead")
    env_cfg, _ = task_registry.get_cfgs("a1_torque_multihead")
    env_cfg.env.num_envs = 2
    results = []
    for made_of in (task_class, watched(task_class)):
        torch.manual_seed(2)
        task = made_of(env_cfg, device)
        for step in range(5):
            obs = task.step(torch.sin(step + torch.arange(48.0, device=device)).view(2, 24))[0]
        results.append(obs["critic"])
    tolerance = 0.0 if device == "cpu" else 1e-3
    torch.testing.assert_close(*results, rtol=tolerance, atol=tolerance)
    total = task.torque_parts.sum(dim=0).clamp(*task.torque_limits)
    torch.testing.assert_close(total, task.torques, rtol=1e-5, atol=1e-4)


def test_targets_of_pd_control(make_task):
    """The torque of the last physics step is that of a spring to the shown target and a damper."""
    task = make_watched(make_task, "a1_position", **{"control.decimation": 1})
    for step in range(5):
        position, velocity = task.dof_pos[1].clone(), task.dof_vel[1].clone()
        task.step(torch.full((2, 12), 0.05 * step))
    snapshot = task.snapshot(0.0, 1)
    torque = task.p_gains[1] * (torch.from_numpy(snapshot.targets) - position) - task.d_gains[1] * velocity
    expected = (torque * task.motor_strength[1]).clamp(*task.torque_limits)
    np.testing.assert_allclose(snapshot.torques, expected.numpy(), atol=1e-3)
    touching = np.linalg.norm(snapshot.forces[task.feet_indices.numpy()], axis=1) > 0.0
    assert snapshot.feet.tolist() == touching.tolist() and snapshot.age == 5


pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

from viser.transforms import SE3

from legged_torque.viewer.scene import FARTHEST, SIDE, commanded_pose, moved, on_ground, side_by_side
from legged_torque.viewer.snapshot import Snapshot

NOTHING = dict.fromkeys(Snapshot.__dataclass_fields__, np.zeros(0))
DT = 0.02


def pose(x=0.0, y=0.0, yaw=0.0):
    """A row of positions, with one joint at 0.7 rad."""
    return np.array([x, y, 0.3, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2), 0.7])


def heading(qpos):
    """The angle about the world's z axis [rad] to which a robot is drawn."""
    return on_ground(qpos).rotation().compute_yaw_radians()


def ghost_after(command, count=80, reset_after=0, qpos=None):
    """The ghost of a robot that stays where it is, by default looking to +y; its episode starts anew after a while."""
    rows = {"qpos": (pose(1.0, 2.0, math.pi / 2) if qpos is None else qpos)[None], "commands": np.array([command])}
    ages = [number - reset_after if number >= reset_after else number for number in range(count)]
    steps = [Snapshot(**{**NOTHING, **rows, "time": i * DT, "age": age, "world": 0}) for i, age in enumerate(ages)]
    return commanded_pose(steps, DT)


def test_ghost_on_a_circle():
    """1 m/s and 1 rad/s for one second: an arc of radius 1 m over 1 rad, from where the robot stood, looking to +y."""
    ghost = ghost_after((1.0, 0.0, 1.0))
    assert ghost[:2] == pytest.approx([1.0 - (1.0 - math.cos(1.0)), 2.0 + math.sin(1.0)], abs=1e-3)
    assert heading(ghost) == pytest.approx(math.pi / 2 + 1.0, abs=1e-6)
    assert ghost[2] == 0.3 and ghost[7] == 0.7


def test_ghost_of_a_tilted_robot():
    """It walks along the heading of the task's commands, the angle by which the trunk was turned before it tilted."""
    ghost = ghost_after((1.0, 0.0, 0.0), qpos=np.array([0.0, 0.0, 0.3, *tilted(0.4), 0.7]))
    assert ghost[:2] == pytest.approx([math.cos(0.4), math.sin(0.4)])


@pytest.mark.parametrize(("count", "reset_after", "seconds"), [(1, 0, 0.0), (21, 0, 0.4), (80, 70, 0.18)])
def test_ghost_of_a_new_episode(count, reset_after, seconds):
    """It follows the commands from the start of the episode, and no further back than is known."""
    ghost = ghost_after((0.0, 0.5, 0.0), count, reset_after)
    assert ghost[:2] == pytest.approx([1.0 - 0.5 * seconds, 2.0])  # its left is -x


def test_side_by_side():
    """The companion starts at the right of the first robot; its steps forward are steps along the first one's front."""
    own, world, placed = pose(3.0, -1.0, math.pi / 2), SE3.from_translation(np.full(3, math.inf)), []
    for other in (
        pose(10.0, 10.0, math.pi),
        pose(9.0, 10.0, math.pi + 0.2),  # 1 m ahead, and turned to the left
        pose(10.0 - FARTHEST - 1.0, 10.0, math.pi),  # too far away
    ):
        world = side_by_side(own, other, world)
        placed.append(moved(other, world))
    np.testing.assert_allclose([one[:2] for one in placed], [[3.0 + SIDE, -1.0], [3.0 + SIDE, 0.0], [3.0 + SIDE, -1.0]])
    assert [heading(one) for one in placed] == pytest.approx([math.pi / 2, math.pi / 2 + 0.2, math.pi / 2])
    assert placed[1][2] == 0.3 and placed[1][7] == 0.7
