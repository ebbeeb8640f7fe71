"""Legs of a robot: chains of joints from the trunk to the ground, their names, mirror images and feet."""

from collections import Counter
from dataclasses import dataclass
from itertools import takewhile

import mujoco
import numpy as np

from legged_torque.importer.shapes import ROUND, Shape, box_around, fit_geom, fit_inertia, lowest_point
from legged_torque.importer.source import Source
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import body_chains, zero_pose

TOLERANCE = 0.01  # distance by which mirror images may miss each other [m]
PARALLEL = 0.9  # least |cosine| of the angle between axes that count as parallel
LEVEL = 0.5  # largest |z| of an axis that counts as level
SIDEWAYS = 0.3  # least |y| of some level axis of a robot that can walk along x
LOW = 0.75  # share of the lowest end's depth below the trunk that the end of a leg reaches
MOST_WITHOUT_ANKLE = 3  # joints of a two-legged robot's leg that ends in a point; those with more have soles
MOST_WITHOUT_SOLE = 4  # the same of robots with more legs
FOOT_REACH = 0.03  # largest distance between the end of a leg and the geom there that is its foot [m]
FLAT = 0.25  # length along the last link, as a share of it, up to which the geom at its end is a foot
HUB = 0.25  # distance of a wheel's center from its axis as a share of its radius
FOOT_WIDENING = 1.1  # radius of a foot at the end of a capsule or box, as a multiple of theirs
FOOT, TRUNK = "foot", "trunk"  # in the names of the geoms of feet and trunk, and of no other
END_NAMES = ("foot", "toe", "sole", "contact")  # in names of fixed links at the ends of legs


@dataclass
class Leg:
    """A chain of joints from the trunk to a foot; bodies are those of the source's model."""

    name: str  # prefix of the names of its joints
    bodies: list[int]
    foot: Shape  # in the frame of the last body
    has_sole: bool  # whether it has an ankle, so that a flat foot stays flat


def pitch_axis(axes: np.ndarray) -> np.ndarray:
    """Return the axis about which most level joints of a leg turn, to the left: the last one of several. Shape: (3,).

    ``axes`` are those of its joints in the world. Shape: (joints, 3).
    """
    alike = (np.abs(axes @ axes.T) > PARALLEL).sum(axis=1) * (np.abs(axes[:, 2]) < LEVEL)
    axis = axes[len(axes) - 1 - int(np.argmax(alike[::-1]))]
    return axis if axis[1] >= 0 else -axis


def free_joints(model: mujoco.MjModel, legs: list[Leg]) -> set[int]:
    """Return the joints that legs bend to walk, counted from 0: all about their pitch axes, and those below."""
    data, free = zero_pose(model), set[int]()
    for leg in legs:
        joints = model.body_jntadr[leg.bodies]
        pitch = joints[np.abs(data.xaxis[joints] @ pitch_axis(data.xaxis[joints])) > PARALLEL]
        free |= {*(pitch - 1).tolist(), *(joints[list(joints).index(pitch[-1]) :] - 1).tolist()}
    return free


def find_shapes(source: Source) -> dict[int, list[Shape]]:
    """Return plain shapes of every body, in its frame; those without any get one from their inertia. Adds notes."""
    model, replaced = source.model, Counter[str]()
    shapes: dict[int, list[Shape]] = {body: [] for body in range(1, model.nbody)}
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if body > 0:
            shape, before = fit_geom(model, geom)
            shapes[body].append(shape)
            if before:
                replaced[f"{before} to {shape.kind}"] += 1
    changes = (f"{count} x {key}" for key, count in sorted(replaced.items()))
    source.notes.on(changes, "spheres, capsules and boxes in the place of other geoms")
    bare = [body for body, found in shapes.items() if not found]
    source.notes.on((model.body(body).name for body in bare), "without collision geoms, shaped by their inertia")
    return shapes | {body: [fit_inertia(model, body)] for body in bare}


def find_legs(source: Source, shapes: dict[int, list[Shape]]) -> list[Leg]:
    """Return the legs in the order of the file, and take their feet out of ``shapes``; a UserError without any.

    Legs are the chains with the lowest ends, in the file's keyframe or with all joints at 0.
    """
    model = source.model
    data = zero_pose(model, next(iter(source.poses.values()), None))
    chains = [chain for chain in body_chains(model) if len(chain) > 1]
    if not chains:
        raise UserError(f"cannot import '{source.file}': it has no legs of two joints or more")
    if not (np.abs(data.xaxis[1:, 1]) > SIDEWAYS).any():
        raise UserError(f"cannot import '{source.file}': x must point forwards and y left, but no joint turns about y")
    along_x, along_y, _ = np.abs(data.xaxis[1:]).sum(axis=0)
    if along_x > along_y + TOLERANCE:
        source.notes.append("more joints turn about x than about y: if it faces along y, turn the file, x is forwards")
    lows = [min(lowest_point(data, chain[-1], shape)[2] for shape in shapes[chain[-1]]) for chain in chains]
    legs = [chain for chain, low in zip(chains, lows, strict=True) if low < LOW * min(lows)]
    if not legs:
        raise UserError(f"cannot import '{source.file}': no leg reaches below its trunk's origin; z must point upwards")
    uses = Counter(body for chain in legs for body in chain)
    if shared := ", ".join(f"'{model.body(body).name}'" for body, count in uses.items() if count > 1):
        raise UserError(f"cannot import '{source.file}': its legs must not branch, or share bodies: {shared}")
    names, found = _leg_names(source, legs, data), []
    for name, chain in zip(names, legs, strict=True):
        foot = _wheel(model, shapes, chain[-1])
        has_sole = not foot and len(chain) > (MOST_WITHOUT_ANKLE if len(legs) == 2 else MOST_WITHOUT_SOLE)
        if has_sole:
            foot = box_around(shapes[chain[-1]], data.xmat[chain[-1]].reshape(3, 3).T)
            shapes[chain[-1]] = []
        found.append(Leg(name, chain, foot or _take_foot(source, shapes, chain[-1]), has_sole))
    return found


def _wheel(model: mujoco.MjModel, shapes: dict[int, list[Shape]], body: int) -> Shape | None:
    """Return the ball in the place of a wheel at the end of a leg, its only shape; None without a wheel."""
    last = max(shapes[body], key=lambda shape: max(shape.half_sizes()))
    joint, (_, middle, radius) = int(model.body_jntadr[body]), sorted(last.half_sizes())
    aside = np.cross(last.pos - model.jnt_pos[joint], model.jnt_axis[joint])
    if np.linalg.norm(aside) > HUB * radius or radius > ROUND * middle:
        return None
    shapes[body] = []
    return _ball(radius, last.pos)


def _ball(radius: float, place: np.ndarray) -> Shape:
    """Return a sphere [m] in the frame of its body."""
    return Shape("sphere", [radius], np.array(place), np.array([1.0, 0.0, 0.0, 0.0]))


def _take_foot(source: Source, shapes: dict[int, list[Shape]], body: int) -> Shape:
    """Return the foot at the end of a leg without a sole, no longer among the shapes; add it where the file has none.

    The end is a fixed link with a name of :data:`END_NAMES`, or where the shape that reaches farthest ends. Adds notes.
    """
    model, found, name = source.model, shapes[body], source.model.body(body).name
    joint = model.jnt_pos[model.body_jntadr[body]]
    last = max(found, key=lambda shape: shape.reach(joint))
    named = [place for site, place in source.sites.get(body, []) if any(part in site.lower() for part in END_NAMES)]
    tip = named[0] if named else last.end(joint)
    far = float(np.linalg.norm(tip - joint))
    near = min(found, key=lambda shape: np.linalg.norm(shape.pos - tip) - min(shape.half_sizes()))
    is_there = np.linalg.norm(near.pos - tip) - min(near.half_sizes()) < FOOT_REACH
    is_small = max(near.half_sizes()) < FOOT_REACH
    if is_there and (near.kind == "sphere" or is_small or near.length((tip - joint) / far) < FLAT * far):
        found.remove(near)
        foot = _ball(max(near.half_sizes()), near.pos) if is_small and near.kind != "sphere" else near
    else:
        foot = _ball(FOOT_WIDENING * float(np.prod(sorted(last.half_sizes())[:2]) ** 0.5), tip)
    if foot is not near:
        source.notes.on([name], f"a sphere of {foot.radius:.3f} m is the foot at the end of")
    spared = {"capsule": 0.5 * foot.radius, "box": -foot.radius, "sphere": np.inf}  # reaching into the foot
    for shape in [shape for shape in found if foot.kind == "sphere" and shape.reach(joint) > far + spared[shape.kind]]:
        shape.shorten(joint, far - foot.radius)
        source.notes.on([name], "shapes that would touch the ground beside the foot are shorter")
    return foot


def _leg_names(source: Source, chains: list[list[int]], data: mujoco.MjData) -> list[str]:
    """Return the prefixes of the names of the legs' joints, new ones where there are none. Adds a note."""
    names = []
    for chain in chains:
        joints = [source.model.joint(source.model.body_jntadr[body]).name for body in chain]
        words = zip(*(joint.split("_") for joint in joints), strict=False)
        names.append("_".join(word for word, *_ in takewhile(lambda same: len(set(same)) == 1, words)))
    clash = any(a and b and a != b and b.startswith(a) for a in names for b in names)
    clash |= any(part in name for name in names for part in (FOOT, TRUNK))
    if all(names) and len(set(names)) == len(names) and not clash:
        return names
    places = [data.xpos[chain[-1]] for chain in chains]
    middle = np.mean([place[0] for place in places])
    ends = ["" if len(chains) == 2 else "F" if place[0] > middle else "R" for place in places]
    names = [end + ("R" if place[1] < 0 else "L") for end, place in zip(ends, places, strict=True)]
    if len(set(names)) < len(names):
        names = [f"leg{number}" for number in range(1, len(names) + 1)]
    source.notes.append(f"names of joints do not begin with that of their leg: prefixed with {', '.join(names)}")
    return names


def joint_names(source: Source, legs: list[Leg], mirrored: list[list[str]]) -> list[str]:
    """Return the names of all joints in the order of the file, beginning with those of their legs.

    Joints are numbered where the rest of a name differs between left and right, and where a part of a name could not
    say which joints two legs hold. Adds a note.
    """
    model, names = source.model, source.joints
    own = {leg.name: [int(model.body_jntadr[body]) - 1 for body in leg.bodies] for leg in legs}
    for leg, joints in own.items():
        for joint in joints:
            names[joint] = names[joint] if names[joint].startswith(leg) else f"{leg}_{names[joint]}"
    kinds = {leg: [names[joint].removeprefix(leg) for joint in joints] for leg, joints in own.items()}
    free = free_joints(model, legs) if len(legs) == 2 else set[int]()
    is_part = any(name in names[joint] for place, name in enumerate(names) if place not in free for joint in free)
    if is_part or any(kinds[right] != kinds[left] for right, left in mirrored):
        reason = "the name of one is part of another's" if is_part else "their names differ between left and right"
        source.notes.append(f"joints are numbered along their legs: {reason}")
        for leg, joints in own.items():
            for place, joint in enumerate(joints, 1):
                names[joint] = f"{leg}_joint{place}"
    return names


def mirrored_legs(source: Source, legs: list[Leg]) -> list[list[str]]:
    """Return pairs of right and left legs whose joints are mirror images of each other when all angles are 0."""
    model, data = source.model, zero_pose(source.model)
    joints = {leg.name: model.body_jntadr[leg.bodies] for leg in legs}
    flip = np.array([1.0, -1.0, 1.0])
    pairs = []
    for right, ours in joints.items():
        for left, theirs in joints.items():
            if data.xanchor[ours[-1], 1] >= 0 or len(ours) != len(theirs):
                continue
            apart = np.abs(data.xanchor[ours] * flip - data.xanchor[theirs]).max()
            turned = np.abs(np.abs((data.xaxis[ours] * -flip * data.xaxis[theirs]).sum(axis=1)) - 1).max()
            if apart < TOLERANCE and turned < TOLERANCE:
                pairs.append([right, left])
    return pairs
