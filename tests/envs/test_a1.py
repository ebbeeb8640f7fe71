"""Joints, options and contacts of the A1's file; its masses and limits are tested in test_robots.py."""

import mujoco
import numpy as np
import pytest

from legged_torque import resource_path

A1_XML = str(resource_path("resources/robots/a1/a1.xml"))
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
