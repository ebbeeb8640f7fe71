"""Rates in Hz: what is meant in time stays the same; rates that do not divide are refused."""

import math

import numpy as np
import pytest
import torch
from support.settings import error_of, get_cfgs

from legged_torque.envs import task_registry
from legged_torque.utils.options import Options

HIGH_UP = ["--set=init_state.pos=[0, 0, 3]"]


def per_second(cfgs):
    """What happens in a second, or is a time in seconds."""
    env, train = cfgs
    step, steps = env.sim.dt * env.control.decimation, 1.0 / (env.sim.dt * env.control.decimation)
    chances = (env.commands.resampling_probability, env.domain_rand.resampling_probability)
    return [
        *(steps * chance for chance in (*chances, env.domain_rand.push_probability)),
        *(steps * math.log(getattr(train.algorithm, name)) for name in ("gamma", "lam")),
        train.evaluation.num_samples * step,
        env.motors.delay.range[1] * env.sim.dt,
        env.sensing.delay.range[1] * step,
        env.terrain.measure_delay * step,
        getattr(env.control, "position_interval", 0) * step,
        env.env.episode_length_s,
    ]


@pytest.mark.parametrize("preset", ["parallel", "paper"])
@pytest.mark.parametrize(
    ("task", "policy", "physics"),
    [
        *(("a1_torque", *rates) for rates in ((100, 200), (25, 1000), (500, 2000))),
        *(("a1_multihead_two_rates", *rates) for rates in ((400, 400), (50, 1000), (200, 1000))),
    ],
)
def test_same_in_time(preset, task, policy, physics):
    """Discounts, random events, pushes of environments, evaluations and delays are those of the task's own rates."""
    words = [f"--preset={preset}", "--perturbation=high"]
    saved = {"motors": {"delay": {"range": [0, 2]}}, "terrain": {"measure_delay": 8}}
    saved |= {"sensing": {"delay": {"range": [0, 8], "unit": "control_steps"}}}
    run = {"env": saved, "train": {}}
    rates = [f"--policy_hz={policy}", f"--physics_hz={physics}"]
    found = get_cfgs(*words, *rates, task=task, run_config=run)
    assert found[0].sim.dt == 1 / physics and found[0].control.decimation == physics // policy
    np.testing.assert_allclose(per_second(found), per_second(get_cfgs(*words, task=task, run_config=run)), rtol=1e-9)


@pytest.mark.parametrize("preset", ["parallel", "paper"])
def test_two_rates_are_the_same_per_second(preset):
    """What happens at 200 Hz of torques and 50 Hz of positions is per second that of 50 Hz of both."""
    words, tasks = [f"--preset={preset}", "--perturbation=high"], ("a1_multihead_two_rates", "a1_multihead")
    fast, slow = (np.delete(per_second(get_cfgs(*words, task=task)), 9) for task in tasks)  # without held positions
    np.testing.assert_allclose(fast, slow, rtol=1e-4)


def test_same_motion():
    """Torques that are held give the same motion and the same rewards per second at two rates of the policy."""
    sums, poses = [], []
    for rate in (50, 100):
        words = ["--num_envs=2", f"--policy_hz={rate}", *HIGH_UP, "--set=rewards.scales.alive=1.0"]
        cfg, _ = get_cfgs(*words, task="a1_torque")
        torch.manual_seed(0)
        task, _ = task_registry.make_env("a1_torque", Options(device="cpu"), cfg)
        for _ in range(rate // 10):
            task.step(torch.full((2, 12), 0.1))
        assert task.max_episode_length == 20 * rate
        poses.append(task.sim.qpos.clone())
        sums.append(task.episode_sums[task.reward_names.index("alive")].clone())
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-5)
    np.testing.assert_allclose(sums, 0.1, rtol=1e-5)


@pytest.mark.parametrize(
    ("task", "words", "name"),
    [
        ("a1_torque", ["--policy_hz=60"], "--policy_hz must divide"),
        ("a1_torque", ["--policy_hz=400"], "--policy_hz must divide"),
        ("a1_torque", ["--physics_hz=125"], "--physics_hz must be a multiple"),
        ("a1_torque", ["--policy_hz=0"], "--policy_hz"),
        ("a1_multihead_two_rates", ["--policy_hz=10"], "control.position_interval"),
    ],
)
def test_rates_that_do_not_divide(task, words, name):
    """They are refused by name, and so is what would not be a whole number of steps."""
    assert name in error_of(get_cfgs, *words, task=task)
    late = {"env": {"motors": {"delay": {"range": [0, 3]}}}, "train": {}}
    line = error_of(get_cfgs, "--physics_hz=300", "--policy_hz=50", run_config=late)
    assert "motors.delay.range must be whole steps" in line
