"""Variants of the A1's file."""

import xml.etree.ElementTree as ElementTree

import pytest

from legged_torque import RESOURCES_DIR

A1 = RESOURCES_DIR / "robots/a1/a1.xml"
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
