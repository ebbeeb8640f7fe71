"""An imported robot: all that its MJCF and its settings need, and notes on what was changed."""

import copy
import keyword
import re
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

import mujoco
import numpy as np

from legged_torque.envs.base.robot_checks import side_problem
from legged_torque.importer.legs import FOOT, TRUNK, Leg, find_legs, find_shapes, joint_names, mirrored_legs
from legged_torque.importer.pose import Stance, find_stance
from legged_torque.importer.shapes import Shape, lowest_point
from legged_torque.importer.source import Source, read_source
from legged_torque.utils.errors import UserError, collect_errors
from legged_torque.utils.mirroring import Mirroring, counterparts, mirror_signs
from legged_torque.utils.mjcf import joint_axes, zero_pose
from legged_torque.utils.standing import hold_pose

UNLIMITED = np.pi  # range of joints without one, to both sides [rad]
IMPLAUSIBLE = 20.0  # multiple of weight times height from which torque limits count as missing
SPEED = 20.0  # highest speed of joints without a limit [rad/s]
FASTEST = 100.0  # speed from which limits count as missing [rad/s]
MUCH_DAMPING = 0.25  # share of the gains' damping from which that of the file may be a servo's
SECONDS = 5.0  # for which the nominal pose is held [s]
LEAST_SHARE = 0.9  # of the contact force on the feet of a robot that stands on them
MOST_TILT = np.radians(10.0)  # of its trunk [rad]


@dataclass
class Robot:
    """A robot to be written; lists are by joint, in the order of the file."""

    name: str
    source: Source
    legs: list[Leg]
    shapes: dict[int, list[Shape]]  # named, by body; feet are among them
    joints: list[str]
    kinds: list[str]  # names of the joints without that of their leg
    ranges: np.ndarray  # [rad]. Shape: (joints, 2)
    torques: np.ndarray  # [N m]
    speed: float  # highest of the joints [rad/s]
    mirrored: list[list[str]]  # pairs of right and left legs
    symmetric: bool  # whether the robot is its own mirror image, at least its joints and what they move
    stance: Stance

    def by_kind(self, values: np.ndarray) -> dict[str, float]:
        """Return numbers by the kinds of joints, to two digits: the highest of each."""
        numbers: dict[str, float] = {}
        for kind, value in zip(self.kinds, values, strict=True):
            numbers[kind] = max(numbers.get(kind, 0.0), float(f"{value:.2g}"))
        return numbers

    def gains(self) -> np.ndarray:
        """Return stiffness [N m/rad] and damping [N m s/rad] as the settings have them. Shape: (2, joints)."""
        tables = self.by_kind(self.stance.stiffness), self.by_kind(self.stance.damping)
        return np.array([[table[kind] for kind in self.kinds] for table in tables])


def import_robot(file: Path, name: str = "", torque_limit: float | None = None) -> Robot:
    """Read a file and derive its robot.

    ``name`` is that of the robot's files and classes, by default that of the file. A ``torque_limit`` [N m] replaces
    those of the file. A UserError says why the file cannot be imported.
    """
    name = name or re.sub(r"\W", "_", file.stem).lower()
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        rule = "of small letters, digits and _, begin with a letter and be no keyword of Python"
        raise UserError(f"--name must be {rule}, not '{name}'")
    source = read_source(file)
    shapes = find_shapes(source)
    legs = find_legs(source, shapes)
    ranges, unlimited = source.model.jnt_range[1:].copy(), source.model.jnt_limited[1:] == 0
    unlimited |= ~np.isfinite(ranges).all(axis=1)
    ranges[unlimited] = -UNLIMITED, UNLIMITED
    source.notes.on(source.which(unlimited), f"without a range, +-{UNLIMITED:.2f} rad given")
    torques = _torques(source, shapes, torque_limit)
    mirrored = mirrored_legs(source, legs)
    if torque_limit is not None:
        source.notes.append(f"torque limits: {torque_limit:g} N m, as given")
    speed = max((limit for limit in source.speed_limits if limit < FASTEST), default=SPEED)
    if speed not in source.speed_limits:
        source.notes.append(f"no speed limits that mean anything: {SPEED:g} rad/s assumed, asset.max_dof_vel")
    stance = find_stance(source, legs, shapes, ranges, torques)
    joints = joint_names(source, legs, mirrored)
    prefixes = [leg.name + "_" for leg in legs]
    asymmetries: list[str] = []
    with collect_errors(asymmetries):
        order = counterparts(joints, mirrored)
        image = Mirroring(order, mirror_signs(joints, joint_axes(source.model)[1:], order))
        pair, sides = image.unlike(stance.angles, joints), copy.copy(source.model)
        sides.jnt_range[1:], sides.jnt_limited[1:], sides.dof_armature[6:] = ranges, 1, stance.armature
        problem = f"the nominal pose has {pair}" if pair else side_problem(sides, torques, image, joints)
        asymmetries += [problem] if problem else []
    source.notes += [f"training without mirror images: {reason}" for reason in asymmetries]
    kinds = [next((j.removeprefix(p) for p in prefixes if j.startswith(p)), j) for j in joints]
    damped = source.model.dof_damping[6:]
    if (damped > MUCH_DAMPING * stance.damping).any():
        source.notes.append(
            f"joint damping up to {damped.max():g} N m s/rad is kept; it often stands for a servo's and is too much "
            "for torque control: set it to 0 if it is not friction that you measured"
        )
    source.notes.append("contacts and options are those of this library's robots: friction 1, condim 3, steps of 5 ms")
    _name_shapes(source, legs, shapes)
    return Robot(name, source, legs, shapes, joints, kinds, ranges, torques, speed, mirrored, not asymmetries, stance)


def check(robot: Robot, data: mujoco.MjData) -> str:
    """Hold the nominal pose of a robot by PD control in plain MuJoCo; return how it went, in a line.

    ``data`` is that of the robot's MJCF, and becomes the last state. A UserError if the simulation diverges.
    """
    model = data.model
    mujoco.mj_resetDataKeyframe(model, data, 0)
    stiffness, damping = robot.gains()
    result = hold_pose(data, stiffness, damping, model.actuator_ctrlrange.T, SECONDS)
    mujoco.mj_forward(model, data)
    on_feet, total, others, force = 0.0, 0.0, dict[str, None](), np.zeros(6)
    for place, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, place, force)
        name = model.geom(int(contact.geom.max())).name  # the floor is the first geom
        total += force[0]
        on_feet += force[0] * (FOOT in name)
        others |= {} if FOOT in name else {name: None}
    problems = []
    if not result.fall and on_feet < LEAST_SHARE * total:
        problems.append(f"{on_feet / total:.0%} of the contact force is on its feet")
    if not result.fall and others:
        problems.append(f"it stands on {', '.join(others)}")
    if not result.fall and result.tilt > MOST_TILT:
        problems.append(f"its trunk is tilted by {np.degrees(result.tilt):.0f} degrees")
    return f"IT DOES NOT STAND ON ITS FEET: {'; '.join(problems)}. {result}" if problems else str(result)


def _torques(source: Source, shapes: dict[int, list[Shape]], given: float | None) -> np.ndarray:
    """Return the torque limits of the joints [N m]. Shape: (joints,). Adds a note."""
    model = source.model
    if given is not None:
        return np.full(model.njnt - 1, given)
    data = zero_pose(model, next(iter(source.poses.values()), None))
    lowest = min(lowest_point(data, body, shape)[2] for body, found in shapes.items() for shape in found)
    enough = float(-source.weight * lowest)
    known = (source.torque_limits > 0) & (source.torque_limits < IMPLAUSIBLE * enough)
    assumed = f"weight x height, {enough:.1f} N m, is assumed; --torque_limit sets them"
    source.notes.on(source.which(~known), f"no torque limits that mean anything, so {assumed}")
    return np.where(known, source.torque_limits, enough)


def _name_shapes(source: Source, legs: list[Leg], shapes: dict[int, list[Shape]]) -> None:
    """Name all shapes after their bodies: trunk, <leg>_<kind>, <leg>_foot; feet join the shapes of their bodies.

    Shapes of the same name are numbered.
    """
    model, taken = source.model, {f"{leg.name}_{FOOT}" for leg in legs}
    owner = {body: leg for leg in legs for body in leg.bodies}
    for body, found in shapes.items():
        name = TRUNK if body == 1 else model.body(body).name or f"body{body}"
        if body in owner:
            leg = owner[body]
            kind = name.removeprefix(leg.name).strip("_") or f"link{leg.bodies.index(body) + 1}"
            name = f"{leg.name}_{kind}"
        if body != 1:
            name = name.replace(FOOT, "sole").replace(TRUNK, "torso")
        for shape in found:
            shape.name = next(n for n in chain([name], (f"{name}_{i}" for i in count(2))) if n not in taken)
            taken.add(shape.name)
    for leg in legs:
        leg.foot.name = f"{leg.name}_{FOOT}"
        shapes[leg.bodies[-1]].append(leg.foot)
