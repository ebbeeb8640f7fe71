"""Parameters of the fused step, one after another, against plain MuJoCo."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from support.fused import assert_alike, compiled, draw_states, make_a1, step_fused, step_mujoco
from support.fused import random as random  # for the edits


def edited_a1(edit):
    """The A1 after a statement about ``spec`` or about ``model``; ``feet`` are the latter's geoms."""
    spec = make_a1()
    if "spec." in edit:
        exec(edit, globals(), {"spec": spec})
    model = compiled(spec)
    if "spec." not in edit:
        exec(edit, globals(), {"model": model, "feet": [i for i in range(18) if "foot" in model.geom(i).name]})
    return model


SOFT, ODD, LINEAR = [0.5, 0.9, 0.02, 0.5, 2.0], [0.3, 0.99, 0.05, 0.2, 3.5], [0.2, 0.9, 0.05, 0.5, 1.0]
PARAMETERS = yaml.safe_load(Path(__file__).with_name("parameters.yaml").read_text("utf-8"))


@pytest.fixture(scope="module")
def on_floor():
    """States of the A1 on the floor, and what plain MuJoCo makes of them."""
    model = compiled(make_a1())
    states = draw_states(model, 32, seed=5)
    return states, step_mujoco(model, states)


@pytest.mark.parametrize("edit", PARAMETERS.values(), ids=PARAMETERS)
def test_parameters(on_floor, edit):
    """Every parameter acts, and acts as in MuJoCo."""
    states, before = on_floor
    model = edited_a1(edit)
    expected = step_mujoco(model, states)
    changed = np.abs(expected[0] - before[0]).max(axis=1) > 1e-2
    assert changed.mean() > 0.2
    assert_alike(model, states, step_fused(model, states), expected)


@pytest.mark.parametrize("friction", [0.1, 0.01, 0.001])
def test_slippery_floors(friction):
    """With little friction contacts are softer than in MuJoCo, for the sake of float32, which is hardly noticed."""
    model = compiled(make_a1())
    model.geom_friction[:, 0] = friction
    states = draw_states(model, 200, seed=6)
    velocities = step_mujoco(model, states)[0]
    error = np.abs(step_fused(model, states)[0] - velocities).max(axis=1)
    change = np.sqrt(np.square(velocities - states["qvel"]).mean())
    assert np.median(error) < 1e-4 * change and error.max() < 0.1 * change
