"""Motors, options and contacts of the A1's file; its masses and joints are tested in test_robots.py."""

import mujoco
import numpy as np
import pytest

from legged_torque import resource_path

A1_XML = str(resource_path("resources/robots/a1/a1.xml"))
TORQUE_LIMIT = 33.5
LEGS = ("FR", "FL", "RR", "RL")
COLLISION_GEOMS = {"trunk"} | {f"{leg}_{part}" for leg in LEGS for part in ("hip", "thigh", "calf", "foot")}


@pytest.fixture(scope="module")
def model():
    """The compiled model."""
    return mujoco.MjModel.from_xml_path(A1_XML)


def named_geoms(model):
    """Ids of the robot's collision geoms by name: every named geom but the floor."""
    names = {model.geom(i).name: i for i in range(model.ngeom)}
    return {name: i for name, i in names.items() if name and name != "floor"}


def test_joint_dynamics(model):
    """Joints have armature 0.01 and friction loss 0.2, no damping, no spring; the free root has none of them."""
    expected = {"dof_armature": 0.01, "dof_frictionloss": 0.2, "dof_damping": 0.0}
    for field, value in expected.items():
        per_dof = getattr(model, field).reshape(model.nv, -1)
        np.testing.assert_allclose(per_dof[:6], 0.0, err_msg=field)
        np.testing.assert_allclose(per_dof[6:, 0], value, err_msg=field)
        np.testing.assert_allclose(per_dof[6:, 1:], 0.0, err_msg=field)
    np.testing.assert_allclose(model.jnt_stiffness, 0.0)


def test_motors_are_plain_torques(model):
    """A control is a torque in N m on its own joint, cut at +-33.5."""
    np.testing.assert_allclose(model.actuator_ctrlrange, [[-TORQUE_LIMIT, TORQUE_LIMIT]] * 12)
    np.testing.assert_allclose(model.actuator_forcerange, [[-TORQUE_LIMIT, TORQUE_LIMIT]] * 12)
    assert model.actuator_ctrllimited.all() and model.actuator_forcelimited.all()
    data = mujoco.MjData(model)
    data.ctrl[:] = np.linspace(-50, 50, 12)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_actuator[6:], np.clip(data.ctrl, -TORQUE_LIMIT, TORQUE_LIMIT))
    np.testing.assert_allclose(data.qfrc_actuator[:6], 0.0)


def test_options(model):
    """Time step, solver, cone and integrator are the project's, the iteration limits MuJoCo's own."""
    fresh = mujoco.MjOption()
    assert model.opt.timestep == pytest.approx(0.005)
    assert model.opt.impratio == pytest.approx(100)
    assert model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert (model.opt.iterations, model.opt.ls_iterations) == (fresh.iterations, fresh.ls_iterations)


def test_collision_geoms(model):
    """There are exactly the named collision geoms, hidden by default, with the published contact parameters."""
    geoms = named_geoms(model)
    assert set(geoms) == COLLISION_GEOMS
    for name, i in [*geoms.items(), ("floor", model.geom("floor").id)]:
        assert model.geom_condim[i] == 3
        assert model.geom_friction[i, 0] == 1.0
        np.testing.assert_array_equal(model.geom_solref[i], (-1000, -80))
        assert model.geom_priority[i] == (1 if name.endswith("_foot") else 0), name
        assert model.geom_group[i] == (0 if name == "floor" else 3), name
    for leg in LEGS:
        foot = model.geom(f"{leg}_foot")
        assert model.body(foot.bodyid[0]).name == f"{leg}_calf"
        assert foot.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE and foot.size[0] == 0.02
        np.testing.assert_allclose(foot.pos, (0, 0, -0.2))


def test_folded_robot_in_the_floor(model):
    """Pushed into the floor and folded into itself, the robot touches the floor with all its parts and nothing else."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2] = 0.0
    data.qpos[7:] = np.tile((0.0, 1.2, -2.6), 4)
    mujoco.mj_forward(model, data)
    floor = model.geom("floor").id
    pairs = data.contact.geom[: data.ncon]
    assert (pairs == floor).any(axis=1).all()
    assert set(pairs[pairs != floor]) == set(named_geoms(model).values())


def test_visual_geoms_can_be_dropped(model):
    """Without its visual geoms the robot is the same machine: same masses, inertias and collision geoms."""
    spec = mujoco.MjSpec.from_file(A1_XML)
    spec.compiler.discardvisual = True
    bare = spec.compile()
    assert bare.ngeom == len(COLLISION_GEOMS) + 1 and bare.nmesh == 0
    assert set(named_geoms(bare)) == COLLISION_GEOMS
    for field in ("body_mass", "body_ipos", "body_inertia", "body_iquat", "body_pos", "dof_armature", "key_qpos"):
        np.testing.assert_array_equal(getattr(bare, field), getattr(model, field), err_msg=field)


def test_cameras(model):
    """The cameras that recordings ask for exist."""
    assert {model.camera(i).name for i in range(model.ncam)} == {"track", "side"}
