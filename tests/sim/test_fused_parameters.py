"""Parameters of the fused step, one after another, against plain MuJoCo."""

import numpy as np
import pytest
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


EQUAL = "model.geom_priority[:] = 0; "
SOFT, ODD, LINEAR = [0.5, 0.9, 0.02, 0.5, 2.0], [0.3, 0.99, 0.05, 0.2, 3.5], [0.2, 0.9, 0.05, 0.5, 1.0]
BENT = "model.jnt_range[:] = (-0.2, 0.3); "
PARAMETERS = {
    "damping": "model.dof_damping[6:] = random(12, 0.0, 3.0)",
    "armature": "model.dof_armature[6:] = random(12, 0.001, 0.1)",
    "springs": "model.jnt_stiffness[1:] = random(12, 0.0, 80.0); model.qpos_spring[7:] = random(12, -1.0, 1.0)",
    "friction of joints": "model.dof_frictionloss[6:] = random(12, 0.0, 4.0)",
    "no friction of some": "model.dof_frictionloss[8:14] = 0.0",
    "its solref": "model.dof_frictionloss[6:] = 5.0; model.dof_solref[:] = (0.1, 0.5)",
    "its solimp": "model.dof_frictionloss[6:] = 5.0; model.dof_solimp[:] = ODD",
    "masses": "model.body_mass[1:] = random(13, 0.2, 6.0)",
    "inertias": "model.body_inertia[1:] = random((13, 3), 0.01, 0.03)",
    "centres of mass": "for i, body in enumerate(spec.bodies[1:]): body.ipos = random(3, -0.1, 0.1, i)",
    "axes of inertia": "for i, body in enumerate(spec.bodies[2:]): body.iquat = random(4, -1.0, 1.0, i)",
    "positions of bodies": "for i, body in enumerate(spec.bodies[2:]): body.pos = random(3, -0.2, 0.1, i)",
    "places of joints": "for i, joint in enumerate(spec.joints[1:]): joint.pos = random(3, -0.1, 0.1, i)",
    "reference angles": "model.qpos0[7:] = random(12, -0.5, 0.5)",
    "ranges of joints": "model.jnt_range[1:, 0] = random(12, -1.0, 0.0); model.jnt_range[1:, 1] = random(12, 0.0, 1.0)",
    "solref of limits": BENT + "model.jnt_solref[:] = (-300.0, -5.0)",
    "solimp of limits": BENT + "model.jnt_solimp[:] = ODD",
    "friction of contacts": "model.geom_friction[:, 0] = random(18, 0.2, 1.5)",
    "friction of the floor": EQUAL + "model.geom_friction[0, 0] = 2.0",
    "size of feet": "for leg in ('FR', 'FL', 'RR', 'RL'): spec.geom(leg + '_foot').size[0] = 0.05",
    "turned box": "spec.geom('trunk').quat = (0.5, 0.1, 0.2, 0.3); spec.geom('trunk').size = (0.3, 0.2, 0.1)",
    "solref": "model.geom_solref[:] = (0.04, 0.6)",
    "solref faster than steps": "model.geom_solref[:] = (0.004, 1.0)",
    "direct solref": "model.geom_solref[:] = (-3000.0, -40.0)",
    "two direct solrefs": EQUAL + "model.geom_solref[0] = (-3000.0, -40.0)",
    "both formats of solref": EQUAL + "model.geom_solref[1:] = (0.04, 0.6); model.geom_solref[0] = (-3000.0, -40.0)",
    "solimp": "model.geom_solimp[:] = SOFT",
    "solimp, power 1": "model.geom_solimp[:] = LINEAR",
    "solimp, other midpoint": "model.geom_solimp[:] = ODD",
    "solimp without width": "model.geom_solimp[:] = [0.5, 0.9, 0.0, 0.5, 2.0]",
    "solmix": EQUAL + "model.geom_solmix[:] = random(18, 0.1, 3.0); model.geom_solimp[0] = SOFT;"
    "model.geom_solref[:, 0] = random(18, 0.02, 0.1); model.geom_solref[:, 1] = 1.0",
    "no solmix": EQUAL + "model.geom_solmix[:] = 0.0; model.geom_solimp[0] = SOFT",
    "priority of the floor": "model.geom_priority[0] = 2; model.geom_solimp[0] = SOFT; model.geom_friction[0, 0] = 0.3",
    "priority of feet": "model.geom_solimp[0] = SOFT; model.geom_friction[0, 0] = 2.0; model.geom_solimp[feet] = ODD",
    "solref of the floor by priority": "model.geom_priority[0] = 2; model.geom_solref[0] = (-400.0, -30.0)",
    "format of solref by priority": "model.geom_solref[feet] = (0.05, 0.5)",
    "gravity": "model.opt.gravity[:] = (1.0, -2.0, -7.0)",
    "impratio": "model.opt.impratio = 3.0",
    "timestep": "model.opt.timestep = 0.002",
    "gear": "model.actuator_gear[:, 0] = random(12, -2.0, 2.0)",
    "ranges of control": "model.actuator_ctrlrange[:] = (-5.0, 12.0)",
    "ranges of force": "model.actuator_forcerange[:] = (-12.0, 4.0)",
    "higher floor": "spec.geom('floor').pos = (0.0, 0.0, 0.05)",
    "tilted floor": "spec.geom('floor').quat = (1.0, 0.05, 0.2, 0.0)",
    "steep floor": "spec.geom('floor').quat = (1.0, 0.35, 0.1, 0.2)",
}


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
