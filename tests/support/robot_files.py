"""Robots' files: variants of the A1's, and some as others publish them: a URDF, a plain MJCF, one like Menagerie's."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np
import pytest

from legged_torque import RESOURCES_DIR

A1 = RESOURCES_DIR / "robots/a1/a1.xml"
ROBOTS = Path(__file__).with_name("robots")
UNITREE_ORDER = ("FL", "FR", "RL", "RR")


@pytest.fixture
def changed(tmp_path):
    """Factory of files: the A1's MJCF with a change of its tree, without its keyframe."""

    def write(*changes):
        root = ElementTree.parse(A1).getroot()
        root.remove(root.find("keyframe"))
        for change in changes:
            change(root)
        ElementTree.ElementTree(root).write(tmp_path / "robot.xml")
        return str(tmp_path / "robot.xml")

    return write


def shuffle_motors(root):
    """Motors in an order that is not that of the joints."""
    motors = root.find("actuator")
    motors[:] = motors[7:] + motors[:7]


def unitree_order(root):
    """Joints FL, FR, RL, RR, motors FR, FL, RR, RL, as in Unitree's go2.xml."""
    trunk = root.find("worldbody/body")
    legs = {leg.get("name")[:2]: leg for leg in trunk.findall("body")}
    for leg in UNITREE_ORDER:
        trunk.remove(legs[leg])
        trunk.append(legs[leg])


def setting(path, **attributes):
    """A change of the attributes of all elements of a path; None takes one away."""

    def change(root):
        found = root.findall(path)
        assert found
        for element in found:
            for name, value in attributes.items():
                element.set(name, value) if value is not None else element.attrib.pop(name)

    return change


def joint(name, **attributes):
    """A change of a joint."""
    return setting(f".//joint[@name='{name}']", **attributes)


def servo(*numbers):
    """A change that makes position servos of some actuators."""

    def change(root):
        for number in numbers:
            actuator = root.find("actuator")[number]
            actuator.tag = "position"
            actuator.attrib.pop("class", None)
            actuator.set("kp", "50")

    return change


EVEN_TRUNK = setting(
    "worldbody/body/inertial", pos="0 0 -0.0005", fullinertia="0.0158533 0.0377999 0.0456542 0 -6.11e-05 0"
)


def turn_left_hips(root):
    """Left hips turn about an axis that points backwards; their range is symmetric."""
    for leg in ("FL", "RL"):
        joint(f"{leg}_hip_joint", axis="-1 0 0")(root)


def urdf():
    """A quadruped as vendors write them: fixed feet and an IMU, cylinders, a mesh that is not there, transmissions."""
    return (ROBOTS / "vendor.urdf").read_text()


def as_mjcf(text):
    """A file in which motors are in another order than joints, limits are ctrlrange, one joint has a servo."""
    return (ROBOTS / "plain.xml").read_text().replace("</mujoco>", f"{text}</mujoco>")


def as_menagerie():
    """A file in the manner of MuJoCo Menagerie.

    It has default classes, visual and collision geoms in groups of their own, visual meshes that are not there, servos
    in another order than joints, damping for those servos, excluded contacts, a site, sensors, and a keyframe.
    """
    return (ROBOTS / "menagerie.xml").read_text()


def read_robot(name):
    """The specification of a robot of the tests."""
    return mujoco.MjSpec.from_file(str(ROBOTS / f"{name}.xml"))


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
