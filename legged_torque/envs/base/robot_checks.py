"""Checks that a robot's file and the settings of a task fit together."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from torch import Tensor

from legged_torque.envs.base.actions import ControlParameters
from legged_torque.sim.model import FLOOR
from legged_torque.sim.randomization import RandomParameter
from legged_torque.utils.mirroring import MIRROR_TOLERANCE, Mirroring
from legged_torque.utils.mjcf import body_chains, colliding_pairs, joint_limits, mass_matrix, zero_pose

UNLIKE = "these are not mirror images of each other"
SIDES = 0.1  # by which sides may differ: ranges [rad], shares of torques and inertias
FAST = 10.0  # velocity at which damping is compared with torques [rad/s]
_POSES = 5  # random ones that are mirrored


def pose_problems(pose: Sequence[float], model: mujoco.MjModel) -> Iterator[str]:
    """Yield angles of the nominal pose [rad], one per joint of the model but the first, that are beyond limits."""
    for joint, (angle, (low, high)) in enumerate(zip(pose, joint_limits(model)[1:], strict=True), start=1):
        if not low <= angle <= high:
            name = model.joint(joint).name
            yield f"init_state.default_joint_angles has {angle:g} for '{name}', whose range is {low:g} to {high:g}"


def foot_notes(model: mujoco.MjModel, feet: Sequence[str]) -> Iterator[str]:
    """Yield legs without a foot, or with another number of foot geoms than most; a leg ends in a childless body."""
    ends = {chain[-1] for chain in body_chains(model)}
    bodies = [int(model.geom(name).bodyid[0]) for name in feet]
    usual = min(bodies.count(body) for body in bodies)
    for body in sorted(ends.union(bodies)):
        if bodies.count(body) != usual:
            has = f"the body '{model.body(body).name}' has {bodies.count(body)} feet"
            yield f"{has}; asset.foot_name chooses {', '.join(feet)}"


def floor_problems(model: mujoco.MjModel, feet: Sequence[str]) -> Iterator[str]:
    """Yield feet that fall through the ground with every engine."""
    pairs, floor = colliding_pairs(model), model.geom(FLOOR).id
    through = [foot for foot in feet if model.geom(foot).id not in pairs[(pairs == floor).any(axis=1)]]
    if through:
        yield f"contype, conaffinity or a flag let {', '.join(through)} through the geom '{FLOOR}'"


def mirror_problem(model: mujoco.MjModel, joints: Mirroring, feet: Mirroring, foot_names: Sequence[str]) -> str:
    """Return how far mirrored joint angles miss mirrored places of the feet; empty if they do not."""
    rng, places = np.random.default_rng(0), []
    low, high = np.clip(joint_limits(model)[1:].T, -1.0, 1.0)
    geoms = [model.geom(name).id for name in foot_names]
    for _ in range(_POSES):
        angles = rng.uniform(low, high)
        for pose in (angles, angles[list(joints.order)] * joints.signs):
            places.append(zero_pose(model, pose).geom_xpos[geoms])
        own, image = places[-2][list(feet.order)] * (1, -1, 1), places[-1]
        missed = np.linalg.norm(own - image, axis=1)
        if missed.max() > MIRROR_TOLERANCE:
            worst = foot_names[int(missed.argmax())]
            return f"mirrored angles put '{worst}' {missed.max():.3g} m away from the mirror image of its counterpart"
    return ""


def side_problem(model: mujoco.MjModel, torques: np.ndarray, joints: Mirroring, names: Sequence[str]) -> str:
    """Return what of a joint, ``torques`` [N m] too, is not the mirror image of its counterpart's; empty if all is."""
    order, signs = list(joints.order), np.array(joints.signs)
    limits = np.clip(joint_limits(model)[1:], -1e3, 1e3)  # [rad]; without a range they are endless
    turned = np.where(signs[:, np.newaxis] > 0.0, limits[order], -limits[order, ::-1])
    parts: list[tuple[str, np.ndarray, np.ndarray, Any]] = [("ranges", limits, turned, 1.0)]
    own = {"torque limits": torques, "damping": FAST * model.dof_damping[6:]}
    own |= {"dry friction": model.dof_frictionloss[6:], "springs": model.jnt_stiffness[1:]}
    parts += [(what, values, values[order], np.maximum(torques, torques[order])) for what, values in own.items()]
    low, high = np.clip(limits.T, -1.0, 1.0)
    for angles in np.random.default_rng(0).uniform(low, high, (_POSES, len(order))):
        both = (zero_pose(model, pose) for pose in (angles, angles[order] * signs))
        inertia, image = (mass_matrix(model, data)[6:, 6:] for data in both)
        about = np.sqrt(np.diag(inertia))
        parts.append(
            ("inertias", inertia, image[np.ix_(order, order)] * np.outer(signs, signs), np.outer(about, about))
        )
    for what, values, image, unit in parts:
        misses = (np.abs(values - image) / unit).reshape(len(order), -1).max(axis=1)
        if misses.max() > SIDES:
            worst = sorted({int(misses.argmax()), order[int(misses.argmax())]})
            return f"the {what} of {' and '.join(names[joint] for joint in worst)}: {UNLIKE}"
    return ""


def control_problem(joints: Mirroring | None, names: Sequence[str], control: ControlParameters, motors: Any) -> str:
    """Return which nominal angle or gain does not fit its counterpart; empty if all do, or joints have no images."""
    if joints is None:
        return ""
    checks = {"init_state.default_joint_angles": (joints, control.default_dof_pos.cpu().numpy())}
    checks["control.stiffness"] = joints.unsigned(), control.p_gains[0].cpu().numpy()
    checks["control.damping"] = joints.unsigned(), control.d_gains[0].cpu().numpy()
    links: dict[str, Any] = {f"motors.{link}": getattr(motors, link, None) for link in motors.chain}
    for path, cfg in links.items():
        for gain, gains in cfg.constants(names, path).items() if getattr(cfg, "_of_law", False) else ():
            checks[f"{path}.{gain}"] = joints.unsigned(), np.array(gains)
    for setting, (image, values) in checks.items():
        if pair := image.unlike(values, names):
            return f"{setting} has {pair}: {UNLIKE}"
    return ""


def range_notes(drawn: Sequence[RandomParameter], fields: Mapping[str, Tensor], torques: np.ndarray) -> Iterator[str]:
    """Yield ranges that seem to be another robot's.

    Such a range leaves out the robot's own value, changes a mass by more than half, or draws dry friction of more than
    a tenth of a joint's highest torque.

    Args:
        drawn: The parameters.
        fields: Those of the model that they are kept in, by name. Shapes: (num_envs, any).
        torques: Highest torques [N m]. Shape: (num_dof,).
    """
    for parameter in drawn:
        (kind, limits), *_ = [*parameter.draw.items(), ("", [0.0, 0.0])]
        if not isinstance(parameter.field, str) or kind not in ("set", "add"):
            continue
        own = fields[parameter.field][0, list(parameter.columns)].cpu().numpy()
        unit = np.broadcast_to(parameter.set_unit if kind == "set" else parameter.add_unit, own.shape)
        low, high = limits
        most = np.abs(unit) * max(-low, high)
        note = ""
        if parameter.field == "body_mass" and (most > 0.5 * own).any():
            note = f"changes a mass of {own[0]:g} kg by {most[0]:g} kg"
        elif parameter.field == "dof_frictionloss" and (most > 0.1 * torques[np.subtract(parameter.columns, 6)]).any():
            note = f"draws up to {most.max():g} N m, but a motor has {torques.min():g} N m"
        elif kind == "set":
            scaled = np.divide(own, unit, out=np.zeros_like(own), where=unit != 0.0)
            outside = scaled[(scaled < low - 1e-6 * abs(low)) | (scaled > high + 1e-6 * abs(high))]
            note = f"draws {low:g} to {high:g}, but the robot's own value is {outside[0]:g}" if outside.size else ""
        if note:
            yield f"domain_rand.{parameter.name} {note}: is it the range of another robot?"
