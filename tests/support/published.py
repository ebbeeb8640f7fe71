"""Robots of tests, some as others publish them: a URDF, a plain MJCF and one in the manner of MuJoCo Menagerie."""

from pathlib import Path

import mujoco

ROBOTS = Path(__file__).with_name("robots")


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
