"""Both engines side by side: MuJoCo Warp's own step runs the same robots, with more rounding."""

import numpy as np
import pytest
import torch
from support.fused import random, step_mujoco
from support.on_device import make_env, make_robot, make_sim, step

from legged_torque.sim.registry import ENGINES

WORLDS = 200


@pytest.fixture(scope="module")
def lively():
    """The A1 near its stance, moving, under torques; what plain MuJoCo makes of it."""
    model = make_robot("a1")
    states = {"qpos": np.tile(model.key_qpos[0], (WORLDS, 1)), "qacc_warmstart": np.zeros((WORLDS, model.nv))}
    states["qpos"][:, 2] = random(WORLDS, 0.25, 0.33)
    states["qpos"][:, 7:] += random((WORLDS, 12), -0.2, 0.2)
    states["qvel"], states["ctrl"] = random((WORLDS, model.nv), -0.5, 0.5, 1), random((WORLDS, model.nu), -9.0, 9.0, 2)
    return model, states, step_mujoco(model, states)


@pytest.mark.parametrize("engine", ENGINES)
def test_one_step(device, lively, engine):
    """From the same states both engines come to the same velocities and contacts: those of plain MuJoCo."""
    model, states, expected = lively
    assert (expected[2] > 0).any(axis=1).mean() > 0.7
    actual = step(make_sim(model, WORLDS, device, engine), states)
    alike = (actual[2] == expected[2]).all(axis=1)  # in others a contact only just touches
    error = np.abs(actual[0] - expected[0]).max(axis=1)[alike]
    assert alike.mean() >= 0.99
    assert np.median(error) < (2e-5 if engine == "fused" else 1e-4) and np.quantile(error, 0.99) < 1e-2, error.max()


def test_mujoco_warp_stands_in_a_graph(device):
    """A task on MuJoCo Warp's step, replayed as a graph, stands on four feet, which carry the robot's weight."""
    words = ["--task=a1_position", "--num_envs=64", "--set=sim.engine=mujoco_warp"]
    words += [f"--set=domain_rand.init_{angle}=[0,0]" for angle in ("roll", "pitch")]
    env, _ = make_env(device, *words, "--set=domain_rand.init_dof_pos_scale=[1,1]")
    for _ in range(80):
        env.step(torch.zeros(64, env.num_actions, device=device))
    force, weight = env.sim.contact_force, 9.81 * 12.453
    assert ((force[:, :, 2] > 5.0).sum(dim=1) == 4).all()
    np.testing.assert_allclose(force.sum(dim=1).cpu().numpy(), [[0.0, 0.0, weight]] * 64, rtol=0, atol=0.02 * weight)
