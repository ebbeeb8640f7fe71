"""Contacts between parts of a robot, for which threads of a world read each other's numbers, against plain MuJoCo."""

import mujoco
import numpy as np
import pytest
from support.fused import step_mujoco
from support.on_device import assert_matches, make_robot, make_sim, step

WORLDS = 300


def touch_each_other(spec):
    """Let all parts that can touch the floor also touch each other."""
    for geom in spec.geoms:
        if geom.conaffinity and geom.name != "floor":
            geom.contype, geom.conaffinity = 2, 3


@pytest.fixture(scope="module")
def folded():
    """An A1 whose parts may touch each other, states with joints anywhere in their ranges, and where parts touch."""
    model, rng = make_robot("a1", touch_each_other), np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (WORLDS, 1))
    qpos[:, 2] = rng.uniform(0.1, 0.4, WORLDS)
    qpos[:, 3:7] += rng.normal(0.0, 0.3, (WORLDS, 4))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qpos[:, 7:] = 1.4 * rng.uniform(*model.jnt_range[1:].T, (WORLDS, model.nu))
    qvel, ctrl = rng.normal(0.0, 1.0, (WORLDS, model.nv)), rng.normal(0.0, 10.0, (WORLDS, model.nu))
    states = {"qpos": qpos, "qvel": qvel, "ctrl": ctrl, "qacc_warmstart": 0.0 * qvel}
    data, counts = mujoco.MjData(model), []
    for data.qpos[:] in qpos:
        mujoco.mj_fwdPosition(model, data)
        counts.append(sum(model.geom_bodyid[pair].all() for pair in data.contact.geom.reshape(-1, 2)))
    return model, states, np.array(counts)


def test_matches_plain_mujoco(device, folded):
    """Legs touch the trunk, and each other, whose equations are solved at once; worlds do not see each other."""
    model, states, counts = folded
    assert (counts > 0).mean() > 0.3 and (counts > 1).mean() > 0.1
    expected, together = step_mujoco(model, states), step(make_sim(model, WORLDS, device), states)
    assert_matches(model, states, together, expected)
    most = np.argsort(counts)[-3:]
    again = step(make_sim(model, WORLDS, device), states)
    alone = step(make_sim(model, 3, device), {name: values[most] for name, values in states.items()})
    for ours, twice, few in zip(together, again, alone, strict=True):
        np.testing.assert_array_equal(ours, twice)
        np.testing.assert_array_equal(ours[most], few)
