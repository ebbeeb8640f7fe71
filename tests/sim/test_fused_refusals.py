"""Models that the fused step refuses by name."""

import mujoco
import numpy as np
import pytest
from support.fused import assert_alike, compiled, draw_states, make_a1, put, step_fused, step_mujoco

from legged_torque import RESOURCES_DIR
from legged_torque.sim.fused.tree import read_tree
from legged_torque.sim.model import max_constraints
from legged_torque.sim.registry import make_engine
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import read_spec

GEOM, JOINT, TRN, DISABLE = mujoco.mjtGeom, mujoco.mjtJoint, mujoco.mjtTrn, mujoco.mjtDisableBit
A1 = RESOURCES_DIR / "robots/a1/a1.xml"
MOTOR = {"gear": [1, 0, 0, 0, 0, 0], "ctrlrange": (-9, 9), "forcerange": (-9, 9), "trntype": TRN.mjTRN_JOINT}
HINGES = "each body but the trunk must have one hinge joint, unlike '"
SPHERE = "type=GEOM.mjGEOM_SPHERE, size=(0.1, 0, 0)"
SITE = "spec.body('FR_calf').add_site(name='site'); spec.add_actuator(name='x', trntype=TRN.mjTRN_SITE, target='site')"
LEGS_MEET = "spec.geom('FR_calf').contype = 2; spec.geom('FL_calf').conaffinity |= 2; "
AIRBORNE = f"spec.body('FL_calf').add_geom({SPHERE}, contype=0, conaffinity=2, condim=3)"
REFUSED = [
    ("spec.delete(spec.joint('root'))", "its trunk is not free"),
    ("spec.joint('root').type = JOINT.mjJNT_HINGE", "its trunk is not free"),
    ("spec.joint('RL_calf_joint').type = JOINT.mjJNT_SLIDE", HINGES),
    (f"spec.body('FL_hip').add_body(name='b').add_geom({SPHERE})", HINGES),
    ("spec.geom('floor').contype = 0", "it needs one plane and no other obstacle"),
    (f"spec.worldbody.add_geom({SPHERE}, pos=(0, 0, -1), condim=3)", "it needs one plane and no other obstacle"),
    (
        "spec.geom('FR_hip').type = GEOM.mjGEOM_ELLIPSOID; spec.geom('FR_hip').size = (0.1, 0.1, 0.2)",
        "only spheres, capsules, cylinders and boxes may collide, unlike 'FR_hip'",
    ),
    (f"spec.geom('FR_calf').type = GEOM.mjGEOM_CYLINDER; {LEGS_MEET}", "unlike 'FR_calf'"),
    (f"spec.geom('FR_calf').contype = 2; {AIRBORNE}.condim = 4", "condim of contacts between its parts must be 3"),
    (f"spec.geom('FR_calf').contype = 2; {AIRBORNE}.margin = 0.1", "geoms have margins or gaps"),
    (f"spec.geom('FR_calf').contype = 2; {AIRBORNE}.solref = (-9, 0.7)", "a solref mixes its two formats"),
    ("spec.geom('RR_foot').condim = 4", "condim of contacts with the floor must be 3"),
    ("spec.geom('RR_foot').margin = 0.01", "geoms have margins or gaps"),
    ("spec.geom('floor').gap = 0.01", "geoms have margins or gaps"),
    ("spec.joint('FR_calf_joint').margin = 0.01", "joint limits have margins"),
    ("spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC", "the friction cone must be pyramidal"),
    ("spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4", "the integrator must be implicitfast or Euler"),
    ("o = spec.option; o.integrator, o.disableflags = 0, DISABLE.mjDSBL_EULERDAMP | 4", "frictionloss, eulerdamp"),
    ("spec.option.enableflags = mujoco.mjtEnableBit.mjENBL_OVERRIDE", "it enables override"),
    ("spec.add_equality(type=2, name1='FR_hip_joint', name2='FL_hip_joint')", "equalities, tendons or mocap"),
    ("spec.add_tendon(name='t').wrap_joint('FR_hip_joint', 1.0)", "equalities, tendons or mocap"),
    ("spec.add_pair(geomname1='floor', geomname2='FR_foot')", "a <pair> with the ground"),
    ("spec.add_pair(geomname1='FL_foot', geomname2='FR_foot', condim=1)", "other than condim 3"),
    ("spec.option.density = 1.2", "it moves through a fluid"),
    ("spec.body('FR_calf').gravcomp = 0.5", "bodies are compensated for gravity"),
    (SITE, "actuators must be motors"),
    ("spec.actuator('FR_hip').set_to_position(kp=10.0)", "actuators must be motors"),
    ("spec.actuator('FR_hip').dyntype = mujoco.mjtDyn.mjDYN_INTEGRATOR", "actuators must be motors"),
    ("spec.actuator('FR_hip').gainprm[0] = 2.0", "actuators must be motors"),
    ("branch(spec.body('FL_thigh'))", "body 'FL_thigh' branches"),
    ("remove_legs(spec)", "it has 0 legs, not 1 to 16"),
    ("spec.add_actuator(target='FR_calf_joint', **MOTOR)", "each motor needs a hinge of its own"),
    ("spec.add_actuator(target='root', **MOTOR)", "each motor needs a hinge of its own"),
    ("spec.joint('FR_calf_joint').actfrcrange = (-5, 5)", "joints limit the forces of their actuators"),
    ("spec.actuators[0].group = 2; spec.option.disableactuator = 4", "it disables groups of actuators"),
    ("spec.option.noslip_iterations = 10", "it has noslip iterations"),
    ("for a in spec.actuators: a.delay, a.nsample = 0.01, 5", "actuators must be motors"),
    ("spec.actuators[0].damping = [1.0, 0.0, 0.0]", "actuators must be motors"),
    ("spec.actuators[0].armature = 0.1", "actuators must be motors"),
    ("spec.joint('FR_calf_joint').stiffness = [1.0, 40.0, 30.0]", "springs or dampers are not linear"),
    ("spec.joint('root').damping = [5.0, 0.0, 0.0]", "the trunk's free joint has passive forces or armature"),
    ("spec.joint('root').frictionloss = 5.0", "the trunk's free joint has passive forces or armature"),
    ("spec.add_exclude(bodyname1='world', bodyname2='FR_calf')", "some contacts are excluded"),
    (f"spec.geom('floor').contype = 0; spec.worldbody.add_geom({SPHERE}, condim=3)", "it needs one plane"),
    ("spec.geom('floor').surfacevel = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]", "surfaces move or stick"),
    ("spec.geom('FR_foot').adhesion = 10.0", "surfaces move or stick"),
    ("branch(spec.worldbody)", "something besides the trunk hangs on the world"),
    ("for _ in range(13): branch(spec.body('trunk'))", "it has 17 legs, not 1 to 16"),
    ("spec.geom('FR_foot').solref = (-500, 0.7)", "a solref mixes its two formats"),
    ("spec.joint('FR_calf_joint').solref_limit = (0.02, -1)", "a solref mixes its two formats"),
]


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
