"""Published robots, and robots of unusual build: what is imported moves like its source, and stands on its feet."""

import mujoco
import numpy as np
import pytest
from support.published_facts import FACTS, published, urdf_of

from legged_torque.importer.check import check
from legged_torque.importer.mjcf import mjcf
from legged_torque.importer.robot import import_robot
from legged_torque.utils.errors import UserError


@pytest.fixture
def imported(tmp_path):
    """Import a text; returns the robot, its model, and its state after 5 s in its nominal pose."""

    def run(text):
        file = tmp_path / "source.xml"
        file.write_text(text)
        robot = import_robot(file, "robot")
        model = mjcf(robot)[1]
        data = mujoco.MjData(model)
        return robot, model, data, check(robot, data)

    return run


def free_accelerations(model, joints, angles):
    """Return how torques accelerate the joints of a robot that floats freely: the same in every frame of its trunk."""
    data, matrix = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    for joint, angle in zip(joints, angles, strict=True):
        data.joint(joint).qpos = angle
    mujoco.mj_forward(model, data)
    for row, unit in zip(matrix, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    dofs = [model.joint(joint).dofadr[0] for joint in joints]
    matrix[dofs, dofs] -= model.dof_armature[dofs]  # which the importer may assume
    return np.linalg.inv(matrix)[np.ix_(dofs, dofs)]


def check_motion(text, robot, model):
    """The imported model moves as MuJoCo's own reading of the source says."""
    spec = mujoco.MjSpec.from_string(text)
    for geom in spec.geoms:
        geom.mass = 0.0 if "<robot" in text else geom.mass
    (root,) = [body for body in spec.worldbody.bodies if len(body.find_all("joint")) > 1]
    if not root.joints:
        root.add_freejoint()
    spec.compiler.fusestatic = True
    source = spec.compile()
    source.dof_armature[:6] = 0.0  # of the free joint, which is left out
    names = [source.joint(i).name for i in range(1, source.njnt)]
    random = np.random.default_rng(0)
    assert model.body_mass.sum() == pytest.approx(source.body_mass.sum(), rel=1e-4)
    for _ in range(3):
        angles = random.uniform(-1, 1, len(names))
        expected, found = (
            free_accelerations(each, joints, angles) for each, joints in ((source, names), (model, robot.joints))
        )
        np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max())


def feet_share(model, data):
    """Return the share of the contact forces on feet, and how many of them touch."""
    on_feet, total, force, touching = 0.0, 0.0, np.zeros(6), set()
    for place in range(data.ncon):
        mujoco.mj_contactForce(model, data, place, force)
        name = model.geom(int(max(data.contact.geom[place]))).name
        total += force[0]
        if name.endswith("_foot"):
            on_feet += force[0]
            touching.add(name)
    return on_feet / total, len(touching)


def check_mirrored(robot, model, tolerance):
    """The feet of a pair are mirror images of each other when all angles are 0."""
    data = mujoco.MjData(model)
    data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    assert robot.mirrored
    for pair in robot.mirrored:
        right, left = (data.geom(f"{leg}_foot").xpos * [1, side, 1] for leg, side in zip(pair, (-1, 1), strict=True))
        np.testing.assert_allclose(right, left, atol=tolerance)


IMPOSSIBLE = {"anymal_c", "hyq"}  # fixed links with inertias that MuJoCo refuses
FALLING = {"bolt", "tron1_sole", "tron1_wheel", "t1", "op3", "h1"}  # two legs that nothing balances


@pytest.mark.parametrize("name", FACTS)
def test_published(imported, name):
    """Masses, inertias and axes are those of the source; a robot stands on all its feet and nothing else."""
    text = published(name)
    robot, model, data, verdict = imported(text)
    if name not in IMPOSSIBLE:
        check_motion(text, robot, model)
    check_mirrored(robot, model, tolerance=0.005)
    if name in FALLING:
        return
    assert verdict.startswith("it stands"), verdict
    assert feet_share(model, data) == (1.0, len(robot.legs))
