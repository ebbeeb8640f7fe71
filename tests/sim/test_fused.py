"""The fused step against plain MuJoCo in double precision, on several robots and with every parameter that it reads."""

import mujoco
import numpy as np
import pytest
import torch
from support.fused import (
    AIR,
    DEEP,
    FLOOR,
    ROBOTS,
    assert_alike,
    compiled,
    draw_states,
    invariants,
    make_a1,
    random,
    step_fused,
    step_mujoco,
)

from legged_torque.sim.registry import make_engine


@pytest.mark.parametrize("heights", [AIR, FLOOR, DEEP], ids=["air", "floor", "deep"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_matches_plain_mujoco(robot, heights):
    """Random states of several robots, on the floor, deep in it and in the air, move as in plain MuJoCo."""
    model = compiled(ROBOTS[robot]())
    states = draw_states(model, 200, heights)
    expected = step_mujoco(model, states)
    share = (expected[2] > 0).any(axis=1).mean()
    assert share == 0.0 if heights == AIR else share > 0.3
    actual = step_fused(model, states, with_forces=robot == "crab")  # whose kernel EngineSuite needs as well
    assert_alike(model, states, actual, expected)


def test_conservation_in_the_air():
    """Without friction, damping and limits, energy and momenta of tumbling robots drift no more than MuJoCo's."""
    model = compiled(make_a1())
    model.dof_frictionloss[:], model.jnt_range[:] = 0.0, (-100.0, 100.0)
    sim = make_engine("fused", model, 8, "cpu", 100, 50)
    sim.qpos.copy_(torch.tensor(model.key_qpos[0]))
    sim.qpos[:, 2] = 5.0
    sim.qvel.copy_(torch.tensor(random((8, 18), -3.0, 3.0)))
    references = [mujoco.MjData(model) for _ in range(8)]
    for world, data in enumerate(references):
        data.qpos[:], data.qvel[:] = sim.qpos[world], sim.qvel[world]
    start = np.array([invariants(model, data) for data in references])
    for _ in range(100):
        sim.step()
        for data in references:
            mujoco.mj_step(model, data)
    expected = np.array([invariants(model, data) for data in references])
    for data, qpos, qvel in zip(references, sim.qpos, sim.qvel, strict=True):
        np.testing.assert_allclose(qpos, data.qpos, rtol=0, atol=5e-5)
        data.qpos[:], data.qvel[:] = qpos, qvel
    actual = np.array([invariants(model, data) for data in references])
    assert 0.1 < np.abs(expected - start)[:, 0].max() < 10.0  # MuJoCo's own drift of some 640 J
    np.testing.assert_allclose(actual[:, 0], expected[:, 0], rtol=0, atol=5e-3)
    np.testing.assert_allclose(actual[:, 1:], expected[:, 1:], rtol=0, atol=2e-4)


def test_limits_of_the_solver():
    """With one iteration the answer is worse but finite, and the more, the better it gets."""
    model = compiled(make_a1())
    states = draw_states(model, 100, seed=3)
    states["qacc_warmstart"][:] = 0.0
    expected = step_mujoco(model, states)[0]
    results = [step_fused(model, states, iterations, 50)[0] for iterations in (1, 3, 100)]
    errors = [np.abs(result - expected).max(axis=1) for result in results]
    assert all(np.isfinite(result).all() for result in results)
    assert errors[0].mean() > 1.5 * errors[1].mean() > 30.0 * errors[2].mean() and errors[2].max() < 3e-3
    assert np.abs(results[0]).max() < 1e3
    one_search = np.abs(step_fused(model, states, 100, 1)[0] - expected).max(axis=1)
    assert np.isfinite(one_search).all() and np.median(one_search) < 1e-4


@pytest.mark.parametrize("scale", [0.0, 10.0, 1e4])
def test_warm_start_does_not_matter(scale):
    """From no, wrong and absurd accelerations the solver finds the same answer."""
    model = compiled(make_a1())
    states = draw_states(model, 100, seed=4)
    expected = step_mujoco(model, states)
    states["qacc_warmstart"] = scale * random(states["qvel"].shape, -1.0, 1.0)
    assert_alike(model, states, step_fused(model, states), expected, worst=5e-3, median=5e-5)
