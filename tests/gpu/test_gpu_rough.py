"""Rough ground: the fused step on height maps against plain MuJoCo, and a training with and without CUDA graphs."""

import mujoco
import numpy as np
import torch
from support.capture import differences
from support.fused import draw_states, make_a1, step_mujoco
from support.maps import make_map, tilted
from support.on_device import assert_matches, make_robot, make_sim, results, step

from legged_torque.terrain.height_map import HeightMap
from tools.accuracy import PlanePerFoot, copy_state, reference_step

WORDS = ["--task=a1_rough_torque_multihead_scan", "--num_envs=512", "--perturbation=low", "--set=evaluation.interval=0"]
WORDS += ["--set=terrain.num_rows=3", "--set=terrain.max_init_terrain_level=2", "--set=runner.num_steps_per_env=8"]
WORDS += ["--set=algorithm.num_mini_batches=2", "--set=algorithm.num_learning_epochs=2", "--set=env.episode_length_s=1"]


def test_graphs_change_nothing(device):
    """Also with a height scan and a terrain curriculum everything that ``recorded`` compares is the same bits."""
    found, _ = differences(device, 4, *WORDS)
    assert found == {}


def test_a_plane_as_a_map(device):
    """A map of a tilted plane gives what plain MuJoCo does with the plane.

    Of boxes that are more than half in it, MuJoCo lets only the lower corners touch: those are not compared.
    """
    along, normal, quat = tilted(0.5, 0.7)

    def tilt(spec):
        spec.geom("floor").quat = quat

    model = make_robot("a1", tilt)
    states = draw_states(model, 200, (0.05, 0.4))
    data, boxes = mujoco.MjData(model), model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    kept = []
    for data.qpos[:] in states["qpos"]:
        mujoco.mj_kinematics(model, data)
        kept.append((data.geom_xpos[boxes] @ normal > 0.0).all())
    states = {name: values[kept] for name, values in states.items()}
    ground = HeightMap(*make_map(lambda x, y: along[0] * x + along[1] * y), device)
    expected = step_mujoco(model, states)
    assert (expected[2] > 0).any(axis=1).mean() > 0.3
    sim = make_sim(make_robot("a1"), int(sum(kept)), device, height_map=ground)
    assert_matches(model, states, step(sim, states), expected)


def feet_only(spec):
    """Let nothing but feet reach the ground: all else that collides is tiny and at the joints."""
    for geom in spec.geoms:
        if geom.conaffinity and not geom.name.endswith("foot") and geom.name != "floor":
            geom.size, geom.pos = [1e-3, 1e-3, 1e-3], [0.0, 0.0, 0.0]


def roofs(x, y):
    """Slopes of 0.8 m by 0.8 m, which meet in ridges and valleys."""
    return 0.3 * np.abs(x % 1.6 - 0.8) + 0.2 * np.abs(y % 1.6 - 0.8)


def test_slopes_under_each_foot(device):
    """Robots that stand on roofs move as in plain MuJoCo with a plane posed under each foot, where that is exact."""
    rng, worlds, model = np.random.default_rng(2), 200, make_robot("a1", feet_only)
    ground = HeightMap(*make_map(roofs, cells=120), device)
    sim, home = make_sim(model, worlds, device, height_map=ground), torch.tensor(model.key_qpos[0], device=device)
    sim.qpos.copy_(home)
    sim.qpos[:, :2] = torch.tensor(rng.uniform(-1.5, 1.5, (worlds, 2)), device=device)
    sim.qpos[:, 2] += 0.4
    for _ in range(150):
        sim.ctrl.copy_(60.0 * (home[7:] - sim.qpos[:, 7:]) - 1.5 * sim.qvel[:, 6:])
        sim.step()
    states = copy_state(sim)
    planes = PlanePerFoot(make_a1(feet_only), [f"{leg}_foot" for leg in ("FR", "FL", "RR", "RL")], ground)
    expected, exact = reference_step(planes.model, states, planes.pose)
    sim.step()
    found = results(sim)
    assert exact.mean() > 0.3 and (found[2][exact] > 0).any(axis=1).mean() > 0.9
    np.testing.assert_allclose(found[0][exact], expected[exact], rtol=0, atol=1e-3)
