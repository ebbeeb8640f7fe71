"""Models that the fused step refuses by name."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from support.fused import assert_alike, compiled, draw_states, make_a1, put, step_fused, step_mujoco
from support.settings import error_of

from legged_torque import RESOURCES_DIR
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.sim.fused.tree import read_tree
from legged_torque.sim.model import max_constraints
from legged_torque.sim.randomization import RandomParameter
from legged_torque.sim.registry import make_engine
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import read_spec

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
    assert message.endswith("; use sim.engine = 'mujoco_warp', about 30 times slower, without randomize_parameters")


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
    assert note.startswith("sim.engine 'mujoco_warp' steps worlds, about 30 times slower than 'fused'")
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


def test_random_parameters_of_the_free_joint():
    """A task cannot draw what would not act."""

    class Robot(LeggedRobot):
        def random_parameters(self):
            return [*super().random_parameters(), RandomParameter("sway", "dof_damping", [6, 0], {"add": [0.0, 1.0]})]

    cfg = A1Cfg()
    cfg.env.num_envs, cfg.domain_rand.randomize_parameters = 2, True
    assert "does not read 'dof_damping' of the trunk's free joint" in error_of(Robot, cfg)


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
