"""Robots of unusual build: what is imported moves like its source, and stands on its feet."""

import re

import mujoco
import numpy as np
import pytest
from support.robot_files import check_motion

from legged_torque.importer.mjcf import mjcf
from legged_torque.importer.robot import check, import_robot
from legged_torque.utils.errors import UserError


def text_of(numbers):
    """Return numbers as XML has them."""
    return " ".join(map(str, numbers))


def urdf_of(links, joints):
    """Return a URDF. Links: name to (mass, com, rpy, inertia) or nothing, and shapes; joints as in the file."""
    parts = []
    for name, (inertial, shapes) in links.items():
        parts.append(f'<link name="{name}">')
        if inertial:
            mass, xyz, rpy, inertia = inertial
            keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
            values = " ".join(f'{key}="{value}"' for key, value in zip(keys, inertia, strict=True))
            place = f'<origin xyz="{text_of(xyz)}" rpy="{text_of(rpy)}"/>'
            parts.append(f'<inertial>{place}<mass value="{mass}"/><inertia {values}/></inertial>')
        for kind, size, xyz, rpy in shapes:
            keys = {"box": ["size"], "sphere": ["radius"], "cylinder": ["radius", "length"]}[kind]
            values = [text_of(size)] if kind == "box" else size
            sizes = " ".join(f'{key}="{value}"' for key, value in zip(keys, values, strict=True))
            place = f'<origin xyz="{text_of(xyz)}" rpy="{text_of(rpy)}"/>'
            parts.append(f"<collision>{place}<geometry><{kind} {sizes}/></geometry></collision>")
        parts.append("</link>")
    for name, kind, parent, child, xyz, rpy, axis, limit in joints:
        keys = ("lower", "upper", "effort", "velocity")
        limits = " ".join(f'{key}="{value}"' for key, value in zip(keys, limit, strict=False))
        parts.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{text_of(xyz)}" rpy="{text_of(rpy)}"/><axis xyz="{text_of(axis)}"/>'
            f"{f'<limit {limits}/>' if limit else ''}</joint>"
        )
    return f'<robot name="robot">{"".join(parts)}</robot>'


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


def legged(places, joints, foot, calf=True):
    """Return links and joints of a robot.

    Args:
        places: Legs by name: x, y [m] and the direction of their x axis [rad] on the trunk.
        joints: Of each leg: axis, then the place of the next joint, or of the foot [m], in its frame.
        foot: Kind, sizes, place and rotation of the shape at the end of each leg.
        calf: Whether links between have shapes.
    """
    box = ["box", [0.35, 0.2, 0.1], [0, 0, 0], [0, 0, 0]]
    links, rows = {"base": [[6, [0, 0, 0], [0, 0, 0], [0.05, 0, 0, 0.08, 0, 0.1]], [box]]}, []
    for leg, (x, y, yaw) in places.items():
        parent, start, turn = "base", [x, y, 0], [0, 0, yaw]
        for number, (axis, end) in enumerate(joints(y), 1):
            name, middle = f"{leg}_link{number}", [part / 2 for part in end]
            rod = [["cylinder", [0.012, max(0.02, -end[2] - 0.02)], middle, [0, 0, 0]]] if calf and end[2] else []
            links[name] = [[0.4, middle, [0, 0, 0], [0.001, 0, 0, 0.001, 0, 0.0004]], rod]
            rows.append([f"{leg}_joint{number}", "revolute", parent, name, start, turn, axis, [-2.6, 2.6, 20, 20]])
            parent, start, turn = name, end, [0, 0, 0]
        kind, size, place, tilt = foot
        links[parent][1].append([kind, size, [a + b for a, b in zip(start, place, strict=True)], tilt])
    return links, rows


FOUR = {"FL": (0.2, 0.1, 0), "FR": (0.2, -0.1, 0), "RL": (-0.2, 0.1, 0), "RR": (-0.2, -0.1, 0)}
SIX = {
    f"{side}{number}": (0.18 * np.cos(yaw), 0.18 * np.sin(yaw), yaw)
    for side, yaws in (("L", (0.9, 1.57, 2.24)), ("R", (-0.9, -1.57, -2.24)))
    for number, yaw in enumerate(yaws, 1)
}
TWO = {"left": (0, 0.08, 0), "right": (0, -0.08, 0)}


def three(y):
    """Return the joints of a dog's leg: hip about x, thigh and calf about y."""
    return [([1, 0, 0], [0, np.sign(y) * 0.06, 0]), ([0, 1, 0], [0, 0, -0.2]), ([0, 1, 0], [0, 0, -0.2])]


def sprawling(y):
    """Return the joints of an insect's leg: about z, then twice about a level axis across."""
    return [([0, 0, 1], [0.05, 0, 0]), ([0, 1, 0], [0, 0, -0.1]), ([0, 1, 0], [0, 0, -0.15])]


def four(y):
    """Return the joints of a leg with an ankle."""
    return [([1, 0, 0], [0, 0, -0.02]), ([0, 1, 0], [0, 0, -0.2]), ([0, 1, 0], [0, 0, -0.2]), ([0, 1, 0], [0, 0, 0])]


def with_root(links, joints, rpy):
    """Put the trunk onto an empty root link."""
    return {"footprint": [[], []], **links}, [
        ["f", "fixed", "footprint", "base", [0, 0, 0.3], rpy, [1, 0, 0], []],
        *joints,
    ]


def with_inertia(links, joints):
    """Make a calf's inertia one that no body can have."""
    links["FL_link3"][0][3] = [0.003, 0, 0, 0.0031, 0, 4e-5]
    return links, joints


def with_parts(links, joints):
    """Add moving links whose names say foot and trunk."""
    for name in ("foot_sensor", "trunk_lid"):
        links[name] = [
            [0.05, [0, 0, 0], [0, 0, 0], [1e-5, 0, 0, 1e-5, 0, 1e-5]],
            [["box", [0.02] * 3, [0] * 3, [0] * 3]],
        ]
        joints.append([name, "revolute", "base", name, [0, 0, 0.1], [0, 0, 0], [0, 0, 1], [-1, 1, 1, 1]])
    return links, joints


def with_spine(links, joints):
    """Let the rear legs begin at a part of the trunk that moves."""
    links["rear"] = [[3, [0, 0, 0], [0, 0, 0], [0.02, 0, 0, 0.02, 0, 0.02]], [["box", [0.1] * 3, [0] * 3, [0] * 3]]]
    for row in joints:
        row[2] = "rear" if row[0] in ("RL_joint1", "RR_joint1") else row[2]
    return links, [*joints, ["spine", "revolute", "base", "rear", [0, 0, 0], [0, 0, 0], [0, 1, 0], [-1, 1, 9, 9]]]


def with_toe(links, joints):
    """Let a calf end in a toe and a heel, which move."""
    links["toe"] = [[0.05, [0, 0, 0], [0, 0, 0], [1e-5, 0, 0, 1e-5, 0, 1e-5]], [["sphere", [0.02], [0] * 3, [0] * 3]]]
    links["heel"] = links["toe"]
    ends = [("toe", [0.05, 0, -0.2]), ("heel", [-0.05, 0, -0.2])]
    moves = ([0, 0, 0], [0, 1, 0], [-1, 1, 9, 9])
    return links, [*joints, *([name, "revolute", "FL_link3", name, place, *moves] for name, place in ends)]


def with_payload(links, joints):
    """Fix a link with a mass to the trunk."""
    links["payload"] = [[0.3, [0, 0, 0], [0, 0, 0], [1e-4, 0, 0, 1e-4, 0, 1e-4]], []]
    return links, [*joints, ["p", "fixed", "base", "payload", [0, 0, 0.1], [0, 0, 0], [1, 0, 0], []]]


LEVEL, ACROSS = [0, 0, 0], [np.pi / 2, 0, 0]
SPHERE = ("sphere", [0.035], [0, 0, 0], LEVEL)
DOG = urdf_of(*legged(FOUR, three, SPHERE))
LOADED = urdf_of(*with_payload(*legged(FOUR, three, SPHERE)))
BASE, COLOR = '<link name="base">', '<material name="a"/>'
UNUSUAL = {
    "feet only": urdf_of(*legged(FOUR, three, SPHERE, calf=False)),
    "wheels": urdf_of(*legged(FOUR, four, ("cylinder", [0.08, 0.03], [0, 0, 0], ACROSS))),
    "boxes": urdf_of(*legged(FOUR, three, ("box", [0.1, 0.06, 0.03], [0, 0, -0.015], LEVEL))),
    "rollers": urdf_of(*legged(FOUR, three, ("cylinder", [0.015, 0.08], [0, 0, 0], ACROSS))),
    "soles of two legs": urdf_of(*legged(TWO, four, ("box", [0.16, 0.08, 0.03], [0.02, 0, -0.05], LEVEL))),
    "six slanted legs": urdf_of(*legged(SIX, sprawling, SPHERE)),
    "turned root": urdf_of(*with_root(*legged(FOUR, three, SPHERE), [0, 0, 3.14159])),
    "impossible calf": urdf_of(*with_inertia(*legged(FOUR, three, SPHERE))),
    "feet's names": urdf_of(*with_parts(*legged(FOUR, three, SPHERE))),
    "masses of geoms": LOADED.replace(BASE, f'<mujoco><compiler inertiafromgeom="true"/></mujoco>{BASE}'),
    "two colors": DOG.replace(BASE, f'{BASE}<visual><geometry><sphere radius="1"/></geometry>{2 * COLOR}</visual>'),
}
"""URDFs of unusual build."""


UNREADABLE = ("impossible calf", "masses of geoms", "two colors")  # by MuJoCo alone


@pytest.mark.parametrize("name", UNUSUAL)
def test_unusual(imported, name):
    """They move as their URDFs say, and stand on all their feet, with as much on right ones as on left ones."""
    text = UNUSUAL[name]
    robot, model, data, verdict = imported(text)
    if name not in UNREADABLE:
        check_motion(text, robot, model)
    check_mirrored(robot, model, tolerance=1e-5)
    assert verdict.startswith("it stands"), verdict
    assert feet_share(model, data) == (1.0, len(robot.legs))
    assert sum("foot" in model.geom(geom).name for geom in range(model.ngeom)) == len(robot.legs)
    assert sum("trunk" in model.geom(geom).name for geom in range(model.ngeom)) == 1
    masses = re.findall('mass value="([^"]*)"', text)
    assert model.body_mass.sum() == pytest.approx(sum(map(float, masses)))


@pytest.mark.parametrize(
    ("change", "shared"), [(with_spine, "'rear'"), (with_toe, "'FL_link1', 'FL_link2', 'FL_link3'")]
)
def test_branching_legs(imported, change, shared):
    """Bodies that would belong to two legs are refused by name."""
    with pytest.raises(UserError, match=f"its legs must not branch, or share bodies: {shared}$"):
        imported(urdf_of(*change(*legged(FOUR, three, SPHERE))))


def test_turned_root(imported):
    """The trunk keeps the axes of an empty root link: what turns the base by pi puts its front legs at the rear."""
    _, model, *_ = imported(UNUSUAL["turned root"])
    assert model.body("FL_link1").pos[:2].tolist() == pytest.approx([-0.2, -0.1], abs=1e-5)


def test_impossible_inertia(imported):
    """A + B >= C is reached by raising the two smaller moments alone, no more than it needs, and told by how much."""
    robot, model, *_ = imported(UNUSUAL["impossible calf"])
    assert model.body("FL_link3").inertia.tolist() == pytest.approx([0.0031, 0.00303, 7e-5], rel=3e-4)
    assert any("'FL_link3' broke A + B >= C by 6e-05 kg m^2, 1.9%" in note for note in robot.source.notes)


def test_flat_inertias(imported):
    """A + B = C, which rounding breaks, stays as near to that as the digits of the MJCF allow."""
    links, joints = legged(FOUR, three, SPHERE)
    random = np.random.default_rng(0)
    flat = {name: random.uniform(1e-4, 9e-4, 2) for name in links if name != "base"}
    for name, (a, b) in flat.items():
        links[name][0][3] = [a, 0, 0, b, 0, a + b]
    _, model, *_ = imported(urdf_of(links, joints))
    for name, (a, b) in flat.items():
        np.testing.assert_allclose(sorted(model.body(name).inertia), sorted([a, b, a + b]), rtol=1e-4)


def test_box_feet(imported):
    """Soles that are boxes are the feet, where they are, and carry the same on the right as on the left."""
    _, model, data, _ = imported(UNUSUAL["boxes"])
    assert model.geom("FR_foot").size.tolist() == [0.05, 0.03, 0.015]
    loads, force = dict.fromkeys(FOUR, 0.0), np.zeros(6)
    for place in range(data.ncon):
        mujoco.mj_contactForce(model, data, place, force)
        loads[model.geom(int(max(data.contact.geom[place]))).name.removesuffix("_foot")] += force[0]
    assert loads["FR"] == pytest.approx(loads["FL"], rel=0.02) and loads["RR"] == pytest.approx(loads["RL"], rel=0.02)
