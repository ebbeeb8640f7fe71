"""Files that others publish: what is imported moves as they say and stands, or a line says why it is refused."""

import importlib.metadata
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import pytest
import yaml
from support.robot_files import check_motion

from legged_torque.importer.mjcf import mjcf
from legged_torque.importer.robot import check, import_robot
from legged_torque.utils.errors import UserError

FILES = yaml.safe_load(Path(__file__).with_name("published.yaml").read_text("utf-8"))


@pytest.fixture(scope="module")
def folder():
    """Where the package has its files."""
    try:
        package = importlib.metadata.distribution("example-robot-data")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip('the package example-robot-data is not installed: pip install -e ".[dev]"')
    return Path(package.locate_file("cmeel.prefix/share/example-robot-data/robots"))


def inertias_only(file):
    """A URDF without what MuJoCo does not read: meshes that it does not find, and inertias of links that weigh 1 mg."""
    root = ElementTree.parse(file).getroot()
    for link in root.findall("link"):
        light = [part for part in link.findall("inertial") if float(part.find("mass").get("value")) < 2e-6]
        for part in [*link.findall("visual"), *link.findall("collision"), *light]:
            link.remove(part)
    return ElementTree.tostring(root, encoding="unicode")


@pytest.mark.parametrize("path", FILES["robots"])
def test_robots(folder, path):
    """Masses, joints and feet are those of the file, as is the motion if MuJoCo reads it; it stands or says it fell."""
    entry = FILES["robots"][path]
    robot = import_robot(folder / path, "robot")
    model = mjcf(robot)[1]
    assert model.body_mass.sum() == pytest.approx(entry["mass"], rel=1e-5)
    assert model.nu == len(robot.joints) == entry["joints"]
    assert [robot.source.model.body(leg.bodies[-1]).name for leg in robot.legs] == entry["feet"]
    if not entry.get("impossible"):  # inertias that MuJoCo refuses
        check_motion(inertias_only(folder / path), robot, model)
    assert check(robot, mujoco.MjData(model)).startswith("IT FELL" if entry.get("falls") else "it stands")


@pytest.mark.parametrize("path", FILES["refused"])
def test_refused(folder, path):
    """The line names what cannot be imported."""
    with pytest.raises(UserError, match=FILES["refused"][path]):
        mjcf(import_robot(folder / path, "robot"))
