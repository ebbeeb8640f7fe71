"""Boxes and capsules that lie across edges of a height map are held, and their contact sensors say so."""

import mujoco
import numpy as np
import pytest
import torch
from support.control import SENSED
from support.fused import compiled, make_a1
from support.maps import Map, ball, heights_under, make_map, simulate

from legged_torque.sim.registry import make_engine
from legged_torque.terrain.height_grid import HeightGrid
from legged_torque.terrain.tiles import TILES, Grid

TRUNK = SENSED.index("trunk")


def torques(target, qpos, qvel):
    """PD control of the A1."""
    return (20.0 * (target - qpos[..., 7:]) - 0.5 * qvel[..., 6:]).clip(-33.5, 33.5)


def test_belly_on_a_ridge():
    """The A1 with its belly on a ridge of 0.5 m, its feet in the air, lies there as plain MuJoCo's on a hfield."""
    heights = np.zeros((81, 81))
    heights[38:43] = 0.5
    ground, spec = HeightGrid(heights, 0.05, (-2.0, -2.0)), make_a1()
    sim = make_engine("fused", compiled(spec), 1, "cpu", height_map=ground)
    start = sim.mj_model.key_qpos[0].copy()
    start[2], start[7:] = 0.567, np.tile([0.0, 0.8, -1.8], 4)
    start[7::3] = -0.5, 0.5, -0.5, 0.5
    ground.add_to(spec, "floor")
    oracle = compiled(spec)
    oracle.opt.timestep = sim.mj_model.opt.timestep
    data, touched = mujoco.MjData(oracle), 0
    data.qpos[:], target = start, torch.tensor(start[7:], dtype=torch.float32)
    sim.qpos.copy_(torch.tensor(start))
    for step in range(400):
        sim.ctrl.copy_(torques(target, sim.qpos, sim.qvel))
        sim.step()
        data.ctrl[:] = torques(start[7:], data.qpos, data.qvel)
        mujoco.mj_step(oracle, data)
        touched += step >= 200 and data.sensordata[4 * TRUNK] > 0
    assert touched > 0 and sim.contact_found[0, TRUNK] > 0
    assert abs(sim.qpos[0, 2].item() - data.qpos[2]) < 0.01


@pytest.mark.parametrize(("kind", "size", "thick"), [("box", "0.2 0.06 0.04", 0.04), ("capsule", "0.03 0.2", 0.03)])
@pytest.mark.parametrize("yaw", [0.0, 0.3])
def test_across_two_ridges(kind, size, thick, yaw):
    """A beam on two ridges, which its ends stick out from, rests on them, and they carry its weight."""
    height_map = make_map(lambda x, y: np.where(np.abs(np.abs(x) - 0.1) < 0.01, 0.3, 0.0) + 0.0 * y, cells=20)
    model = ball(0.5, kind, size)
    sim = simulate(model, height_map, [[0.0, 0.0, 0.3 + thick]])
    level = np.array([1.0, 0.0, 0.0, 0.0]) if kind == "box" else np.array([0.5**0.5, 0.0, 0.5**0.5, 0.0])
    quat = np.zeros(4)
    mujoco.mju_mulQuat(quat, np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), level)
    sim.qpos[0, 3:7] = torch.tensor(quat)
    forces = []
    for _ in range(600):
        sim.step()
        forces.append(sim.contact_force[0, 0].clone())
    assert abs(sim.qpos[0, 2] - 0.3 - thick) < 0.005
    np.testing.assert_allclose(torch.stack(forces)[-200:].mean(0), [0.0, 0.0, 9.81 * model.body_mass.sum()], atol=0.5)


def deepest(height_map, model, qpos):
    """How deep the surface is in the A1's trunk at most [m], by points a centimetre apart. Shape: (worlds,)."""
    data, half, out = mujoco.MjData(model), model.geom("trunk").size, []
    offsets = np.stack(np.meshgrid(*[np.arange(-0.18, 0.18, 0.01)] * 2, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    for data.qpos[:] in qpos:
        mujoco.mj_kinematics(model, data)
        points = data.geom("trunk").xpos + offsets
        points[:, 2] = heights_under(height_map, points)
        local = (points - data.geom("trunk").xpos) @ data.geom("trunk").xmat.reshape(3, 3)
        out.append(max(0.0, (half - np.abs(local)).min(axis=1).max()))
    return np.array(out)


@pytest.mark.parametrize(("kind", "difficulty"), [("stairs_up", 1.0), ("stepping_stones", 0.7)])
def test_trunks_in_the_ground_are_felt(kind, difficulty):
    """Robots fall about: no trunk is 3.5 cm deep in the ground; at most 1% are deeper than 1 cm and feel nothing."""
    heights, rng = TILES[kind](difficulty, np.random.default_rng(0), Grid(160, 0.05)), np.random.default_rng(1)
    height_map = Map(heights.astype(np.float32), 0.05, (-4.0, -4.0))
    sim = make_engine("fused", compiled(make_a1()), 24, "cpu", height_map=height_map)
    sim.mj_model.opt.timestep = 0.005
    home = torch.tensor(sim.mj_model.key_qpos[0], dtype=torch.float32)
    sim.qpos.copy_(home)
    places, around = rng.uniform(-3.0, 3.0, (24, 2)), np.stack(np.meshgrid(*[np.linspace(-0.3, 0.3, 13)] * 2), axis=-1)
    sim.qpos[:, :2] = torch.tensor(places)
    sim.qpos[:, 2] += torch.tensor(heights_under(height_map, places[:, None, None] + around).max(axis=(1, 2)))
    silent, deep = [], []
    for step in range(600):
        if step % 100 == 0:
            target = home[7:] + torch.tensor(rng.uniform(-0.8, 0.8, (24, 12)), dtype=torch.float32)
        sim.ctrl.copy_(torques(target, sim.qpos, sim.qvel))
        before = sim.qpos.numpy().copy()
        sim.step()
        if step % 20 == 19:  # the sensors are those of the step's start
            deep.append(deepest(height_map, sim.mj_model, before))
            silent.append((deep[-1] > 0.01) & (sim.contact_found[:, TRUNK] == 0).numpy())
    assert np.mean(silent) <= 0.01 and 0.01 < np.max(deep) < 0.035
