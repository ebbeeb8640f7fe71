"""Legs of a robot: chains of joints from the trunk to the ground, their names, mirror images and feet."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from legged_torque.importer.shapes import Shape, box_around, fit_geom, fit_inertia
from legged_torque.importer.source import Source
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import body_chains

TOLERANCE = 0.01  # [m] by which mirror images may miss each other
FOOT_RADIUS = 0.02  # [m] of a foot that the file has a place for and no geom
END_NAMES = ("foot", "toe", "sole", "contact")  # in names of fixed links at the ends of legs


@dataclass
class Leg:
    """A chain of joints from the trunk to a foot; bodies are those of the source's model."""

    name: str  # with which the names of its joints begin
    bodies: list[int]
    foot: Shape  # in the frame of the last body

    @property
    def is_walking_on_soles(self) -> bool:
        """Whether it has an ankle, so that a flat foot stays flat."""
        return len(self.bodies) > 4


def zero_pose(model: mujoco.MjModel, joints: np.ndarray | None = None) -> mujoco.MjData:
    """Return the state with the trunk level at the origin and these angles [rad] of the joints (default: 0)."""
    data = mujoco.MjData(model)
    data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
    data.qpos[7:] = 0.0 if joints is None else joints
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def find_shapes(source: Source) -> dict[int, list[Shape]]:
    """Return plain shapes of every body, in its frame; those without any get one from their inertia. Adds notes."""
    model, replaced = source.model, dict[str, int]()
    shapes: dict[int, list[Shape]] = {body: [] for body in range(1, model.nbody)}
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if body > 0:
            shape, before = fit_geom(model, geom)
            shapes[body].append(shape)
            if before:
                key = f"{before} to {shape.kind}"
                replaced[key] = replaced.get(key, 0) + 1
    if replaced:
        changes = ", ".join(f"{count} x {key}" for key, count in sorted(replaced.items()))
        source.notes.append(f"spheres, capsules and boxes in the place of other geoms: {changes}")
    bare = [body for body, found in shapes.items() if not found]
    for body in bare:
        shapes[body] = [fit_inertia(model, body)]
    if bare:
        names = ", ".join(model.body(body).name for body in bare)
        source.notes.append(f"without collision geoms, shaped by their inertia: {names}")
    return shapes


def find_legs(source: Source, shapes: dict[int, list[Shape]]) -> list[Leg]:
    """Return the legs in the order of the file, and take their feet out of ``shapes``; a UserError without any.

    Legs are those chains whose ends are the lowest, in the file's keyframe or with all joints at 0.
    """
    model = source.model
    data = zero_pose(model, source.pose)
    chains = [chain for chain in body_chains(model) if len(chain) > 1]
    if not chains:
        raise UserError(f"cannot import '{source.file}': it has no legs of two joints or more")
    if not (np.abs(data.xaxis[1:, 1]) > 0.7).any():
        raise UserError(f"cannot import '{source.file}': x must point forwards and y left, but no joint turns about y")
    along_x, along_y, _ = np.abs(data.xaxis[1:]).sum(axis=0)
    if along_x > along_y + TOLERANCE:
        source.notes.append("more joints turn about x than about y: if it faces along y, turn the file, x is forwards")
    lows = [_lowest(data, chain[-1], shapes[chain[-1]]) for chain in chains]
    legs = [chain for chain, low in zip(chains, lows, strict=True) if low < 0.75 * min(lows)]
    if not legs:
        raise UserError(f"cannot import '{source.file}': no leg reaches below its trunk's origin; z must point upwards")
    names = _leg_names(source, legs, data)
    return [Leg(name, chain, _take_foot(source, shapes, chain, data)) for name, chain in zip(names, legs, strict=True)]


def _lowest(data: mujoco.MjData, body: int, shapes: list[Shape]) -> float:
    """Return the height [m] of the lowest point of a body's shapes, over the trunk's origin."""
    matrix = data.xmat[body].reshape(3, 3)
    return min(float((s.ends() @ matrix.T + data.xpos[body])[:, 2].min() - s.radius) for s in shapes)


def _take_foot(source: Source, shapes: dict[int, list[Shape]], chain: list[int], data: mujoco.MjData) -> Shape:
    """Return the foot at the end of a leg, no longer among the shapes; add it where the file has none."""
    model, body = source.model, chain[-1]
    found = shapes[body]
    if len(chain) > 4:  # a sole, flat on the ground with level trunk
        shapes[body] = []
        return found[0] if len(found) == 1 else box_around(found, data.xmat[body].reshape(3, 3).T)
    places = source.sites.get(body, [])
    named = [place for name, place in places if any(part in name.lower() for part in END_NAMES)]
    joint = model.jnt_pos[model.body_jntadr[body]]
    reach = [float(np.linalg.norm(shape.ends() - joint, axis=1).max() + shape.radius) for shape in found]
    last = int(np.argmax(reach))
    if found[last].kind == "sphere" and len(found) > 1:
        return found.pop(last)
    ends = found[last].ends()
    tip = named[0] if named else ends[np.argmax(np.linalg.norm(ends - joint, axis=1))]
    near = [i for i, shape in enumerate(found) if np.linalg.norm(shape.pos - tip) < 0.03 and len(found) > 1]
    radius = FOOT_RADIUS
    if near:
        radius = float(np.mean(found.pop(near[0]).half_sizes()))
    elif found[last].kind == "capsule":
        radius = 1.1 * found[last].radius
    source.notes.append(f"a sphere of {radius:.3f} m is the foot at the end of '{model.body(body).name}'")
    return Shape("sphere", [radius], np.array(tip), np.array([1.0, 0, 0, 0]))


def _leg_names(source: Source, chains: list[list[int]], data: mujoco.MjData) -> list[str]:
    """Return the names with which the names of the legs' joints begin, renaming joints where there are none."""
    names = []
    for chain in chains:
        joints = [source.model.joint(source.model.body_jntadr[body]).name for body in chain]
        prefix = _common(joints)
        names.append(prefix[: prefix.rfind("_")] if "_" in prefix else "")
    clash = any(a and b and a != b and b.startswith(a) for a in names for b in names)
    if all(names) and len(set(names)) == len(names) and not clash:
        return names
    places = [data.xpos[chain[-1]] for chain in chains]
    middle = np.mean([place[0] for place in places])
    if len(chains) == 2:
        names = ["R" if place[1] < 0 else "L" for place in places]
    else:
        names = [("F" if x > middle else "R") + ("R" if y < 0 else "L") for x, y, _ in places]
    if len(set(names)) < len(names):
        names = [f"leg{number}" for number in range(1, len(names) + 1)]
    source.notes.append(f"names of joints do not begin with that of their leg: prefixed with {', '.join(names)}")
    return names


def _common(names: list[str]) -> str:
    """Return what all names begin with."""
    same = [len(set(letters)) == 1 for letters in zip(*names, strict=False)]
    return names[0][: same.index(False) if False in same else len(same)]


def joint_names(source: Source, legs: list[Leg], mirrored: list[list[str]]) -> list[str]:
    """Return the names of all joints in the order of the file, beginning with that of their leg.

    Where names differ on the other side beyond that, joints are numbered. Adds a note.
    """
    owner = {body: leg.name for leg in legs for body in leg.bodies}
    owners = [owner.get(source.body_of(joint), "") for joint in range(len(source.joints))]
    names = [name if name.startswith(leg) else f"{leg}_{name}" for name, leg in zip(source.joints, owners, strict=True)]
    kinds = {
        leg.name: [n.removeprefix(leg.name) for n, o in zip(names, owners, strict=True) if o == leg.name]
        for leg in legs
    }
    if all(kinds[right] == kinds[left] for right, left in mirrored):
        return names
    source.notes.append("joints are numbered along their legs: their names differ between left and right")
    places = {body: place for leg in legs for place, body in enumerate(leg.bodies, 1)}
    return [
        f"{leg}_joint{places[source.body_of(joint)]}" if leg else name
        for joint, (name, leg) in enumerate(zip(names, owners, strict=True))
    ]


def mirrored_legs(source: Source, legs: list[Leg]) -> list[list[str]]:
    """Return pairs of right and left legs whose joints are mirror images of each other when all angles are 0."""
    model, data = source.model, zero_pose(source.model)
    axes = {leg.name: np.array([data.xaxis[model.body_jntadr[b]] for b in leg.bodies]) for leg in legs}
    places = {leg.name: np.array([data.xanchor[model.body_jntadr[b]] for b in leg.bodies]) for leg in legs}
    flip = np.array([1.0, -1.0, 1.0])
    pairs = []
    for right in legs:
        for left in legs:
            if places[right.name][-1][1] >= 0 or len(right.bodies) != len(left.bodies):
                continue
            apart = np.abs(places[right.name] * flip - places[left.name]).max()
            turned = np.abs(np.abs((axes[right.name] * -flip * axes[left.name]).sum(axis=1)) - 1).max()
            if apart < TOLERANCE and turned < TOLERANCE:
                pairs.append([right.name, left.name])
    return pairs


def world_shape(data: mujoco.MjData, body: int, shape: Shape) -> np.ndarray:
    """Return where in the world frame a shape's center is, at the height of its lowest point [m]. Shape: (3,)."""
    ends = shape.ends() @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
    return np.append(ends.mean(axis=0)[:2], ends[:, 2].min() - shape.radius)
