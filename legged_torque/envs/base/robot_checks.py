"""Whether a robot's file and the settings of a task fit together; what does not is told, never silently wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from legged_torque.sim.model import FLOOR
from legged_torque.sim.randomization import Parameter
from legged_torque.utils.mirroring import Mirroring
from legged_torque.utils.mjcf import joint_limits

MIRROR_TOLERANCE = 5e-3  # by which a foot may miss the mirror image of its counterpart [m]
_POSES = 5  # random ones that are mirrored


def pose_problems(pose: Sequence[float], model: mujoco.MjModel) -> Iterator[str]:
    """Yield which angles of the nominal pose [rad], one per joint of the model but the first, are beyond limits."""
    for joint, (angle, (low, high)) in enumerate(zip(pose, joint_limits(model)[1:], strict=True), start=1):
        if not low <= angle <= high:
            name = model.joint(joint).name
            yield f"init_state.default_joint_angles has {angle:g} for '{name}', whose range is {low:g} to {high:g}"


def foot_notes(model: mujoco.MjModel, feet: Sequence[str]) -> Iterator[str]:
    """Yield which legs have no foot, or a foot of other numbers of geoms: a leg ends in a body without children."""
    ends = set(range(2, model.nbody)) - set(model.body_parentid.tolist())
    bodies = [int(model.geom(name).bodyid[0]) for name in feet]
    usual = min(bodies.count(body) for body in bodies)
    for body in sorted(ends.union(bodies)):
        if bodies.count(body) != usual:
            has = f"the body '{model.body(body).name}' has {bodies.count(body)} feet"
            yield f"{has}; asset.foot_name chooses {', '.join(feet)}"


def floor_problems(model: mujoco.MjModel, feet: Sequence[str]) -> Iterator[str]:
    """Yield which feet the ground lets through, whichever engine simulates them."""
    kinds, floor = (model.geom_contype, model.geom_conaffinity), model.geom(FLOOR).id
    through = [f for f in feet if not any(a[floor] & b[model.geom(f).id] for a, b in (kinds, kinds[::-1]))]
    if through:
        yield f"contype and conaffinity let {', '.join(through)} through the geom '{FLOOR}'"


def mirror_problem(model: mujoco.MjModel, joints: Mirroring, feet: Mirroring, foot_names: Sequence[str]) -> str:
    """Return why mirrored angles of joints do not put feet at mirrored places; empty if they do."""
    rng, data, places = np.random.default_rng(0), mujoco.MjData(model), []
    low, high = np.clip(joint_limits(model)[1:].T, -1.0, 1.0)
    geoms = [model.geom(name).id for name in foot_names]
    for _ in range(_POSES):
        angles = rng.uniform(low, high)
        for pose in (angles, angles[list(joints.order)] * joints.signs):
            data.qpos[:7], data.qpos[7:] = (0, 0, 0, 1, 0, 0, 0), pose
            mujoco.mj_kinematics(model, data)
            places.append(data.geom_xpos[geoms].copy())
        own, image = places[-2][list(feet.order)] * (1, -1, 1), places[-1]
        missed = np.linalg.norm(own - image, axis=1)
        if missed.max() > MIRROR_TOLERANCE:
            worst = foot_names[int(missed.argmax())]
            return f"mirrored angles put '{worst}' {missed.max():.3g} m beside the mirror image of its counterpart"
    return ""


def range_notes(drawn: Sequence[Parameter], torques: np.ndarray) -> Iterator[str]:
    """Yield which ranges may be another robot's.

    They leave out the robot's own value, or change a mass by more than half, or draw dry friction of more than a tenth
    of a joint's highest torque. Those are ``torques`` [N m]. Shape: (num_dof,).
    """
    for parameter in (each for each in drawn if each.model_field):
        columns = list(parameter.columns)
        own = parameter.field[0, columns].cpu().numpy()
        weight, (low, high) = np.broadcast_to(parameter.weight, own.shape), parameter.offset
        most = np.abs(weight) * max(-low, high)
        told = ""
        if parameter.model_field == "body_mass" and (most > 0.5 * own).any():
            told = f"changes a mass of {own[0]:g} kg by {most[0]:g} kg"
        elif parameter.model_field == "dof_frictionloss" and (most > 0.1 * torques[np.subtract(columns, 6)]).any():
            told = f"draws up to {most.max():g} N m, but a motor has {torques.min():g} N m"
        elif parameter.base is not None:
            scaled = np.divide(own - parameter.base, weight, out=np.zeros_like(own), where=weight != 0.0)
            outside = scaled[(scaled < low - 1e-6 * abs(low)) | (scaled > high + 1e-6 * abs(high))]
            told = f"draws {low:g} to {high:g}, but the robot's own value is {outside[0]:g}" if outside.size else ""
        if told:
            yield f"domain_rand.{parameter.name} {told}: is it the range of another robot?"
