"""The fused step against plain MuJoCo in double precision: robots, every parameter that it reads, what it refuses."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import yaml
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
    put,
    random,
    step_fused,
    step_mujoco,
)

from legged_torque import RESOURCES_DIR
from legged_torque.sim.fused.tree import read_tree
from legged_torque.sim.model import max_constraints
from legged_torque.sim.registry import make_engine
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import read_spec


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


GEOM, JOINT, TRN, DISABLE = mujoco.mjtGeom, mujoco.mjtJoint, mujoco.mjtTrn, mujoco.mjtDisableBit
A1 = RESOURCES_DIR / "robots/a1/a1.xml"
MOTOR = {"gear": [1, 0, 0, 0, 0, 0], "ctrlrange": (-9, 9), "forcerange": (-9, 9), "trntype": TRN.mjTRN_JOINT}
LEGS_MEET = "spec.geom('FR_calf').contype = 2; spec.geom('FL_calf').conaffinity |= 2; "
REASONS = yaml.safe_load(Path(__file__).with_name("refused.yaml").read_text("utf-8"))
REFUSED = [(edit, reason) for reason, edits in REASONS.items() for edit in edits]
if hasattr(mujoco.MjsJoint, "springyield"):  # not in MuJoCo 3
    YIELD = "j = spec.joint('FR_calf_joint'); j.stiffness = [1.0, 0.0, 0.0]; j.springyield = 0.1"
    REFUSED.append((YIELD, "springs or dampers are not linear"))


def branch(body):
    """Add a body on a hinge."""
    body.add_body().add_joint(axis=(1, 0, 0), range=(-1, 1))
    body.bodies[-1].mass, body.bodies[-1].inertia, body.bodies[-1].explicitinertial = 1.0, (1, 1, 1), True


def remove_legs(spec):
    """Leave the trunk alone."""
    for leg in ("FR", "FL", "RR", "RL"):
        spec.delete(spec.body(f"{leg}_hip"))


@pytest.mark.parametrize(("edit", "reason"), [pytest.param(*case, id=case[0][:60]) for case in REFUSED])
def test_refused(edit, reason):
    """A robot with anything that the step does not simulate is refused, by its reason."""
    spec = read_spec(A1)
    for key in list(spec.keys):
        spec.delete(key)
    exec(edit, globals(), {"spec": spec})
    model = spec.compile()
    with pytest.raises(UserError) as error:
        read_tree(model)
    message = str(error.value)
    assert message.startswith("sim.engine 'fused' cannot simulate this robot: ") and reason in message
    advice = "; use sim.engine = 'mujoco_warp', in training about 8 times slower, without randomize_parameters"
    assert message.endswith(advice)


CALF_MEETS_THIGH = "spec.geom('FR_calf').contype = 2; spec.geom('FR_thigh').conaffinity |= 2"
ACCEPTED = [
    CALF_MEETS_THIGH,
    LEGS_MEET + "spec.add_exclude(bodyname1='FL_calf', bodyname2='FR_calf')",
    "spec.add_exclude(bodyname1='FL_calf', bodyname2='FR_calf')",
    "spec.add_equality(type=2, name1='FR_hip_joint', name2='FL_hip_joint', active=False)",
    "spec.option.wind = (5, 0, 0)",
    "spec.option.enableflags = mujoco.mjtEnableBit.mjENBL_ENERGY",
]


@pytest.mark.parametrize("edit", ACCEPTED, ids=[edit[-60:] for edit in ACCEPTED])
def test_accepted(edit):
    """Settings that change no motion are accepted, and indeed plain MuJoCo moves as without them."""
    spec = make_a1()
    exec(edit, globals(), {"spec": spec})
    model = compiled(spec)
    states = draw_states(compiled(make_a1()), 10, seed=7)
    assert np.array_equal(step_mujoco(model, states)[0], step_mujoco(compiled(make_a1()), states)[0])
    expected = step_mujoco(model, states)
    assert_alike(model, states, step_fused(model, states), expected)


def test_solver_of_the_file():
    """PGS, which MuJoCo Warp does not have, is no reason to refuse a robot: solvers find the same minimum."""
    spec = make_a1()
    spec.option.solver = mujoco.mjtSolver.mjSOL_PGS
    states = draw_states(compiled(make_a1()), 10, seed=7)
    assert_alike(
        compiled(make_a1()), states, step_fused(compiled(spec), states), step_mujoco(compiled(make_a1()), states)
    )


def test_engine_that_is_slower():
    """A note of MuJoCo Warp's own step says how much slower it is, and why the fused step is no choice."""
    assert not make_engine("fused", compiled(make_a1()), 1).notes
    assert "which can simulate this robot" in make_engine("mujoco_warp", compiled(make_a1()), 1).notes[0]
    spec = make_a1()
    for key in list(spec.keys):
        spec.delete(key)
    branch(spec.body("FL_thigh"))
    (note,) = make_engine("mujoco_warp", compiled(spec), 1).notes
    assert note.startswith("sim.engine 'mujoco_warp' steps worlds, in training about 8 times slower than 'fused'")
    assert note.endswith("which cannot simulate this robot: body 'FL_thigh' branches")


def test_rows_of_closed_loops():
    """MuJoCo Warp gets room for the constraint rows of closed loops, as many as MuJoCo makes."""
    spec = make_a1()
    for kind in ("CONNECT", "WELD"):
        loop = spec.add_equality(type=getattr(mujoco.mjtEq, f"mjEQ_{kind}"), objtype=mujoco.mjtObj.mjOBJ_BODY)
        loop.name1, loop.name2 = "FR_calf", "RR_calf"
    spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1="FR_hip_joint", name2="FL_hip_joint")
    model = compiled(spec)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rows = (data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY).sum()
    assert rows == 10 == max_constraints(model, 0) - max_constraints(compiled(make_a1()), 0)


def test_tolerance():
    """``opt.tolerance`` acts: where everything is good enough, the solver stops after its second iteration."""
    model = compiled(make_a1())
    states, counts = draw_states(model, 30, seed=8), []
    for tolerance in (1e-8, 1e9):
        model.opt.tolerance = tolerance
        sim = make_engine("fused", model, 30, "cpu")
        put(sim, states)
        sim.step()
        counts.append(sim.solver_niter.numpy().copy())
    assert counts[0].max() > 4 and counts[1].max() <= 2
