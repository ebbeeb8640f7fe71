"""Legs of a robot: chains of joints from the trunk to the ground, their names, mirror images and feet."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import takewhile

import mujoco
import numpy as np

from legged_torque.importer.shapes import Shape, box_around, fit_geom, fit_inertia
from legged_torque.importer.source import Source
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import body_chains

TOLERANCE = 0.01  # distance by which mirror images may miss each other [m]
PITCHING = 0.7  # least |y| of the axis of a joint that turns about y
LOW = 0.75  # share of the lowest end's depth below the trunk that the end of a leg reaches
MOST_WITHOUT_ANKLE = 4  # joints of a leg that ends in a point; those with more have an ankle and a sole
FOOT_RADIUS = 0.02  # of a foot that the file has a place for and no geom [m]
FOOT_REACH = 0.03  # largest distance of a geom at the end of a leg that becomes its foot [m]
FOOT_WIDENING = 1.1  # radius of a foot at the end of a capsule, as a multiple of the capsule's
END_NAMES = ("foot", "toe", "sole", "contact")  # in names of fixed links at the ends of legs


@dataclass
class Leg:
    """A chain of joints from the trunk to a foot; bodies are those of the source's model."""

    name: str  # prefix of the names of its joints
    bodies: list[int]
    foot: Shape  # in the frame of the last body

    @property
    def has_sole(self) -> bool:
        """Whether it has an ankle, so that a flat foot stays flat."""
        return len(self.bodies) > MOST_WITHOUT_ANKLE


def zero_pose(model: mujoco.MjModel, joints: np.ndarray | None = None) -> mujoco.MjData:
    """Return the state with the trunk level at the origin and these angles [rad] of the joints (default: 0)."""
    data = mujoco.MjData(model)
    data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
    data.qpos[7:] = 0.0 if joints is None else joints
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def lowest_point(data: mujoco.MjData, body: int, shape: Shape) -> np.ndarray:
    """Return the center of a shape in the world, at the height of its lowest point [m]. Shape: (3,)."""
    ends = shape.ends() @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
    return np.append(ends.mean(axis=0)[:2], ends[:, 2].min() - shape.radius)


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
    data = zero_pose(model, source.pose)
    chains = [chain for chain in body_chains(model) if len(chain) > 1]
    if not chains:
        raise UserError(f"cannot import '{source.file}': it has no legs of two joints or more")
    if not (np.abs(data.xaxis[1:, 1]) > PITCHING).any():
        raise UserError(f"cannot import '{source.file}': x must point forwards and y left, but no joint turns about y")
    along_x, along_y, _ = np.abs(data.xaxis[1:]).sum(axis=0)
    if along_x > along_y + TOLERANCE:
        source.notes.append("more joints turn about x than about y: if it faces along y, turn the file, x is forwards")
    lows = [min(lowest_point(data, chain[-1], shape)[2] for shape in shapes[chain[-1]]) for chain in chains]
    legs = [chain for chain, low in zip(chains, lows, strict=True) if low < LOW * min(lows)]
    if not legs:
        raise UserError(f"cannot import '{source.file}': no leg reaches below its trunk's origin; z must point upwards")
    names = _leg_names(source, legs, data)
    return [Leg(name, chain, _take_foot(source, shapes, chain, data)) for name, chain in zip(names, legs, strict=True)]


def _take_foot(source: Source, shapes: dict[int, list[Shape]], chain: list[int], data: mujoco.MjData) -> Shape:
    """Return the foot at the end of a leg, no longer among the shapes; add it where the file has none."""
    model, body = source.model, chain[-1]
    found = shapes[body]
    if len(chain) > MOST_WITHOUT_ANKLE:  # a sole, flat on the ground with level trunk
        shapes[body] = []
        return found[0] if len(found) == 1 else box_around(found, data.xmat[body].reshape(3, 3).T)
    joint = model.jnt_pos[model.body_jntadr[body]]
    reach = [float(np.linalg.norm(shape.ends() - joint, axis=1).max() + shape.radius) for shape in found]
    last = found[int(np.argmax(reach))]
    if last.kind == "sphere" and len(found) > 1:
        found.remove(last)
        return last
    sites = source.sites.get(body, [])
    named = [place for name, place in sites if any(part in name.lower() for part in END_NAMES)]
    ends = last.ends()
    tip = named[0] if named else ends[np.argmax(np.linalg.norm(ends - joint, axis=1))]
    near = [shape for shape in found if np.linalg.norm(shape.pos - tip) < FOOT_REACH and len(found) > 1]
    radius = FOOT_RADIUS
    if near:
        found.remove(near[0])
        radius = float(np.mean(near[0].half_sizes()))
    elif last.kind == "capsule":
        radius = FOOT_WIDENING * last.radius
    source.notes.append(f"a sphere of {radius:.3f} m is the foot at the end of '{model.body(body).name}'")
    return Shape("sphere", [radius], np.array(tip), np.array([1.0, 0.0, 0.0, 0.0]))


def _leg_names(source: Source, chains: list[list[int]], data: mujoco.MjData) -> list[str]:
    """Return the prefixes of the names of the legs' joints, new ones where there are none. Adds a note."""
    names = []
    for chain in chains:
        joints = [source.model.joint(source.model.body_jntadr[body]).name for body in chain]
        words = zip(*(joint.split("_") for joint in joints), strict=False)
        names.append("_".join(word for word, *_ in takewhile(lambda same: len(set(same)) == 1, words)))
    clash = any(a and b and a != b and b.startswith(a) for a in names for b in names)
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

    Where the rest of a name differs between left and right, joints are numbered. Adds a note.
    """
    model, names = source.model, source.joints
    own = {leg.name: [int(model.body_jntadr[body]) - 1 for body in leg.bodies] for leg in legs}
    for leg, joints in own.items():
        for joint in joints:
            names[joint] = names[joint] if names[joint].startswith(leg) else f"{leg}_{names[joint]}"
    kinds = {leg: [names[joint].removeprefix(leg) for joint in joints] for leg, joints in own.items()}
    if any(kinds[right] != kinds[left] for right, left in mirrored):
        source.notes.append("joints are numbered along their legs: their names differ between left and right")
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
