"""Control steps that replay as a CUDA graph.

They compute the same as without a graph, never wait for the GPU, take no memory, keep bad numbers in their world, and
draw random numbers of the right distributions.
"""

import math

import numpy as np
import pytest
import torch
from scipy.stats import kstest
from support.on_device import make_env, no_waiting, use_graphs, used_memory

WORLDS = 1024
WORDS = ["--task=a1_torque_multihead", f"--num_envs={WORLDS}", "--perturbation=low"]


def actions_of(env, step):
    """Random actions, the same in each step of each test."""
    generator = torch.Generator(env.device).manual_seed(step)
    return torch.randn(env.num_envs, env.num_actions, device=env.device, generator=generator)


def outcome(env, step):
    """Take a step from a seed, and return copies of what came of it."""
    torch.manual_seed(100 + step)
    obs, rewards, dones, extras = env.step(actions_of(env, step))
    exact = {"dones": dones, "time outs": extras["time_outs"], "qpos": env.sim.qpos, "qvel": env.sim.qvel}
    rounded = {**obs, "rewards": rewards, "episode sums": env.episode_sums, "air time": env.feet_air_time}
    return tuple({name: value.clone() for name, value in part.items()} for part in (exact, rounded))


def test_compiled_as_eager(device, capfd):
    """A step compiled by ``torch.compile`` differs by rounding only, and no part of it is left uncompiled."""
    eager, compiled = (make_env(device, *WORDS, "--set=env.episode_length_s=1")[0] for _ in range(2))
    compiled.compile()
    for env in (eager, compiled):
        torch.manual_seed(0)
        env.reset()
        env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=int(env.max_episode_length))
    ended = 0
    for step in range(12):
        (exact, rounded), (same, close) = outcome(eager, step), outcome(compiled, step)
        ended += int(exact["dones"].sum())
        for name, value in exact.items():
            assert torch.equal(same[name], value), (step, name)
        for name, value in rounded.items():
            torch.testing.assert_close(close[name], value, rtol=1e-4, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}")
    assert ended > 100 and "uncompiled" not in capfd.readouterr().err


@pytest.fixture(scope="module")
def walking(device):
    """A compiled task whose steps are replayed."""
    env, _ = make_env(device, *WORDS)
    env.compile()
    for step in range(4):
        env.step(actions_of(env, step))
    return env


def test_a_step_waits_for_nothing(device, walking):
    """Nothing is read back to the host, replayed or not: torch would refuse it here."""
    actions = actions_of(walking, 0)
    for is_replayed in (False, True):
        use_graphs(walking, is_replayed)
        walking.step(actions)
        with no_waiting(device):
            for _ in range(5):
                walking.step(actions)


def test_a_thousand_steps_take_no_memory(device, walking):
    """What torch and Warp hold of the GPU stays as it is."""
    actions = actions_of(walking, 0)
    before = used_memory(device)
    for _ in range(1000 if device != "cpu" else 10):
        walking.step(actions)
    assert used_memory(device) == before


def test_bad_numbers_end_their_world(device):
    """In a replayed step their worlds start anew without a reward; the others are unchanged to the bit."""
    broken, healthy = (make_env(device, *WORDS)[0] for _ in range(2))
    worlds = torch.tensor([3, 500, WORLDS - 1], device=device)
    others = torch.ones(WORLDS, dtype=torch.bool, device=device)
    others[worlds] = False
    for env in (broken, healthy):
        torch.manual_seed(0)
        env.reset()
    for step in range(8):
        actions = actions_of(broken, step)
        if step == 4:
            broken.sim.qpos[worlds[0], 8] = math.nan
            broken.sim.qvel[worlds[1], 10] = math.inf
        results = []
        for env in (broken, healthy):
            torch.manual_seed(step)
            given = actions.clone()
            if step == 4 and env is broken:
                given[worlds[2], 0] = math.nan
            obs, rewards, dones, _ = env.step(given)
            state = (env.sim.qpos, env.sim.qvel)
            results.append([tensor.clone() for tensor in (*obs.values(), rewards, dones, *state)])
        for mine, other in zip(*results, strict=True):
            assert torch.isfinite(mine).all() and torch.equal(mine[others], other[others]), step
        if step == 4:
            assert results[0][3][worlds].all() and not results[0][2][worlds].any()
    assert int(broken.num_diverged) == 3 and int(healthy.num_diverged) == 0


NUM = 4096
MANY = [*WORDS, f"--num_envs={NUM}"]
HIGH_UP = "--set=init_state.pos=[0,0,50]"  # nothing falls
DRAWN = {  # numbers of a field of the model, and their range of the published set "default"
    "body_mass": (1, (4.713 - 1.0, 4.713 + 1.0)),
    "dof_damping": (6, (0.0, 0.2)),
    "dof_armature": (17, (0.008, 0.02)),
    "dof_frictionloss": (10, (0.0, 0.4)),
    "jnt_stiffness": (12, (0.0, 0.2)),
    "gravity": (2, (-10.11, -9.51)),
}


def take_steps(env, count):
    """Let robots do nothing for some steps."""
    for _ in range(count):
        env.step(torch.zeros(env.num_envs, env.num_actions, device=env.device))


def assert_uniform(values, low, high):
    """Kolmogorov's test, which 1 in 100,000 samples of a uniform distribution fails."""
    sample = values.double().cpu().numpy().ravel()
    assert kstest(sample, "uniform", (low, high - low)).statistic * np.sqrt(len(sample)) < 2.5


def numbers(env):
    """The chosen number of each field in all worlds. Shape: (fields, num_envs)."""
    fields = {name: env.sim.field(name).flatten(1) for name in DRAWN}
    return torch.stack([field[:, DRAWN[name][0]] for name, field in fields.items()])


def test_parameters(device):
    """Draws are uniform in their ranges, no two of them go together, and each step draws in its share of worlds."""
    env, _ = make_env(device, *MANY, HIGH_UP, "--set=domain_rand.resampling_probability=0.3")
    take_steps(env, 3)
    before = numbers(env).clone()
    take_steps(env, 1)
    after = numbers(env)
    changed = (after != before).any(dim=0)
    assert abs(float(changed.float().mean()) - 0.3) < 4.0 * math.sqrt(0.21 / NUM)
    assert (after[:, ~changed] == before[:, ~changed]).all()
    for values, (_, limits) in zip(after, DRAWN.values(), strict=True):
        assert_uniform(values, *limits)
        assert_uniform(values[changed], *limits)
    correlation = torch.corrcoef(torch.cat([after, before])[:, changed]) - torch.eye(2 * len(DRAWN), device=device)
    assert correlation.abs().max() < 4.5 / math.sqrt(int(changed.sum()))
