"""Rough ground: the fused step on height maps against plain MuJoCo, and a training with and without CUDA graphs."""

from support.fused import step_mujoco
from support.maps import assert_feet_meet_planes, states_on_slope
from support.on_device import assert_matches, differences, make_robot, make_sim, step

WORDS = ["--task=a1_rough_torque_multihead_scan", "--num_envs=512", "--perturbation=low", "--set=evaluation.interval=0"]
WORDS += ["--set=terrain.num_rows=3", "--set=terrain.max_init_terrain_level=2", "--set=runner.num_steps_per_env=8"]
WORDS += ["--set=algorithm.num_mini_batches=2", "--set=algorithm.num_learning_epochs=2", "--set=env.episode_length_s=1"]


def test_graphs_change_nothing(device):
    """With a height scan and a terrain curriculum, too, everything that ``recorded`` compares is the same bits."""
    found, _ = differences(device, 4, *WORDS)
    assert found == {}


def test_a_plane_as_a_map(device):
    """A map of a tilted plane gives what plain MuJoCo does with the plane."""
    tilted, states, ground = states_on_slope(0.5, 200)
    expected = step_mujoco(tilted, states)
    assert (expected[2] > 0).any(axis=1).mean() > 0.3
    sim = make_sim(make_robot("a1"), len(states["qpos"]), device, height_map=ground)
    assert_matches(tilted, states, step(sim, states), expected)


def test_slopes_under_each_foot(device):
    """On slopes that meet in ridges and valleys, each foot meets the plane under it."""
    assert_feet_meet_planes(200, device)
