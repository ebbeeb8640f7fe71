"""How a robot moves, by its file and as it was imported."""

import mujoco
import numpy as np
import pytest


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
