"""The numbers of the robot, the ground and the controller that are drawn at random (paper, App. I-B)."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from torch import Tensor

from legged_torque.envs.base.actions import ControlParameters
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.symmetry import RobotSymmetry
from legged_torque.sim.randomization import Randomization, RandomParameter, fixed
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import Limits
from legged_torque.utils.mirroring import MIRROR_TOLERANCE, VECTOR, Mirroring
from legged_torque.utils.mjcf import joint_limits, zero_pose
from legged_torque.utils.options import CONTACT

TRUNK = 1  # the trunk's body
_ROUND = {int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)}  # types of feet that have a radius
BOUNDS = {"body_mass": Limits(0.01), "body_inertia": Limits(above=0)} | dict.fromkeys(
    ["geom_size", "geom_friction", "dof_damping", "dof_armature", "dof_frictionloss", "jnt_stiffness"], Limits(0)
)
"""What no draw of these fields of the model may leave."""


def initial_state(
    cfg: LeggedRobotCfg, model: mujoco.MjModel, qpos: Tensor, qvel: Tensor, angles: Tensor, pose: Sequence[float]
) -> list[RandomParameter]:
    """Return the state in which episodes start, without its last entry, the place: see :func:`initial_place`.

    Args:
        cfg: Settings of the task.
        model: The robot.
        qpos: Positions of all worlds. Shape: (num_envs, nq).
        qvel: Velocities of all worlds. Shape: (num_envs, nv).
        angles: Roll, pitch and yaw of the trunk [rad]. Shape: (num_envs, 3).
        pose: The nominal angles of the joints [rad].
    """
    rand, dofs = cfg.domain_rand, range(len(pose))
    limits = joint_limits(model)[1:].T.tolist()

    def drawn(name: str, field: Tensor, columns: Sequence[int], unit: str) -> RandomParameter:
        """Return numbers that are set from the range ``name``."""
        return RandomParameter(name, field, columns, {"set": getattr(rand, name)}, unit)

    dof_pos = RandomParameter("dof_pos", qpos, [7 + dof for dof in dofs], {"scale": rand.init_dof_pos_scale}, "rad")
    return [
        RandomParameter("base_height", qpos, [2], {}, "m", own=cfg.init_state.pos[2]),
        *(drawn(f"init_{angle}", angles, [i], "rad") for i, angle in enumerate(("roll", "pitch", "yaw"))),
        dataclasses.replace(dof_pos, own=pose, limits=(limits[0], limits[1])),
        drawn("init_lin_vel", qvel, range(3), "m/s"),
        drawn("init_ang_vel", qvel, range(3, 6), "rad/s"),
        drawn("init_dof_vel", qvel, [6 + dof for dof in dofs], "rad/s"),
    ]


def initial_place(cfg: LeggedRobotCfg, qpos: Tensor) -> RandomParameter:
    """Return x and y at which episodes start [m]."""
    place = {"add": cfg.domain_rand.init_place}
    return RandomParameter("init_place", qpos, range(2), place, "m", own=cfg.init_state.pos[:2])


def robot_parameters(
    draws: Mapping[str, Any],
    model: mujoco.MjModel,
    foot_names: Sequence[str],
    control: ControlParameters,
    torque_limits: Tensor,
    symmetry: RobotSymmetry,
) -> list[RandomParameter]:
    """Return the parameters of the robot; its joints may keep their own values, all at once.

    Args:
        draws: The ranges of ``domain_rand`` by name.
        model: The robot.
        foot_names: Names of the feet's geoms.
        control: Gains, in units of which "add" ranges of damping and stiffness are.
        torque_limits: Highest torques [N m], in units of which "add" ranges of dry friction are. Shape: (num_dof,).
        symmetry: Which joints and feet are mirror images of each other.
    """
    dofs, joints = range(6, model.nv), range(1, model.njnt)
    feet = [model.geom(name).id for name in foot_names]
    inertia_per_mass = list(model.body_inertia[TRUNK] / model.body_mass[TRUNK])
    joint_values = symmetry.joints and symmetry.joints.unsigned()
    foot_vectors = symmetry.foot_geoms and _mirror_images_of_vectors(model, feet, symmetry.foot_geoms)
    are_round = set(model.geom_type[feet]) <= _ROUND
    foot_radius = draws["foot_radius"] if are_round or "scale" not in draws["foot_radius"] else {}

    def of_joints(name: str, field: str, columns: Sequence[int], unit: str, add_unit: Any = 1.0) -> RandomParameter:
        """Return a parameter with a number per joint."""
        more: dict[str, Any] = {"may_keep": True, "mirror": joint_values}
        return RandomParameter(name, field, columns, draws[name], unit, add_unit=add_unit, **more)

    mass, inertia, radii = draws["trunk_mass"], entries(3, [TRUNK]), [3 * foot for foot in feet]
    trunk: dict[str, Any] = {"shared": True, "set_unit": inertia_per_mass, "add_unit": inertia_per_mass}
    com: dict[str, Any] = {"shared": True, "listed_by_column": True, "mirror": VECTOR}
    return [
        RandomParameter("trunk_mass", "body_mass", [TRUNK], mass, "kg"),
        RandomParameter("trunk_inertia", "body_inertia", inertia, mass, "kg m^2", same_draw_as="trunk_mass", **trunk),
        RandomParameter("trunk_com", "body_ipos", entries(3, [TRUNK]), draws["trunk_com"], "m", **com),
        RandomParameter("foot_radius", "geom_size", radii, foot_radius, "m", shared=True),
        RandomParameter("foot_pos", "geom_pos", entries(3, feet), draws["foot_pos"], "m", mirror=foot_vectors),
        of_joints("dof_damping", "dof_damping", dofs, "N m s/rad", control.d_gains[0].tolist()),
        of_joints("dof_armature", "dof_armature", dofs, "kg m^2"),
        of_joints("dof_stiffness", "jnt_stiffness", joints, "N m/rad", control.p_gains[0].tolist()),
        of_joints("dof_frictionloss", "dof_frictionloss", dofs, "N m", torque_limits.tolist()),
    ]


def _mirror_images_of_vectors(model: mujoco.MjModel, geoms: Sequence[int], of_geoms: Mirroring) -> Mirroring | None:
    """Return the mirroring of a vector per geom, in its body's frame; None unless axes are images of axes."""
    frames = zero_pose(model).xmat[model.geom_bodyid[geoms]].reshape(-1, 3, 3)
    order, signs = list[int](), list[float]()
    for frame, other in zip(frames, of_geoms.order, strict=True):
        image = frame.T @ np.diag(VECTOR.signs) @ frames[other]
        if np.abs(image - image.round()).max() > MIRROR_TOLERANCE:
            return None
        axes = np.abs(image).argmax(axis=1)
        order += (3 * other + axes).tolist()
        signs += image.round()[range(3), axes].tolist()
    return Mirroring(tuple(order), tuple(signs))


def ground_parameters(draws: Mapping[str, Any], model: mujoco.MjModel) -> list[RandomParameter]:
    """Return the parameters of the ground, the same for all geoms of a world; arguments as of robot_parameters."""
    geoms = [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
    friction = model.geom_friction[geoms]  # tangential, torsional, rolling
    kinds = list((friction / friction[:, :1]).ravel())
    slides: dict[str, Any] = {"shared": True, "set_unit": kinds, "add_unit": kinds}

    def of_solref(part: int, **more: Any) -> RandomParameter:
        """Return a number of all solrefs; those of MuJoCo's direct format, which are set, are negative."""
        name, own = CONTACT[part], model.geom_solref[geoms, part].tolist()
        columns, signs = [2 * geom + part for geom in geoms], [1.0 if number > 0.0 else -1.0 for number in own]
        more |= {"own": own, "set_unit": -1.0, "add_unit": signs, "shared": True, "bounds": Limits(0)}
        return RandomParameter(name, "geom_solref", columns, draws[name], **more)

    down: dict[str, Any] = {"set_unit": -1.0, "add_unit": -1.0, "bounds": Limits(0)}
    return [
        RandomParameter("ground_friction", "geom_friction", entries(3, geoms), draws["ground_friction"], **slides),
        of_solref(0),
        of_solref(1, same_draw_as=CONTACT[0]),
        RandomParameter("gravity", "gravity", [2], draws["gravity"], "m/s^2", **down),
    ]


def control_parameters(
    draws: Mapping[str, Any], control: ControlParameters, strength: Tensor, symmetry: RobotSymmetry
) -> list[RandomParameter]:
    """Return the parameters of motors and controller; arguments as of robot_parameters.

    ``strength`` are the factors of all motors. Shape: (num_envs, num_dof).
    """
    joints, mirror = range(strength.shape[1]), symmetry.joints

    def of_joints(name: str, field: Tensor, unit: str) -> RandomParameter:
        """Return a parameter with one draw for all joints, and one per joint if it has such a range."""
        images = mirror.unsigned() if mirror and "scale_per_joint" in draws[name] else None
        return RandomParameter(name, field, joints, draws[name], unit, shared=True, bounds=Limits(0), mirror=images)

    scale = draws["action_scale"]
    return [
        of_joints("motor_strength", strength, ""),
        RandomParameter("joint_offset", control.joint_offset, joints, draws["joint_offset"], "rad", mirror=mirror),
        RandomParameter("action_scale", control.action_scale, [0], scale, "rad", bounds=Limits(0)),
        RandomParameter(
            "torque_scale",
            control.torque_scale,
            [0],
            scale,
            "N m",
            same_draw_as="action_scale",
            set_unit=control.torque_per_position,
            add_unit=control.torque_per_position,
        ),
        of_joints("stiffness", control.p_gains, "N m/rad"),
        of_joints("damping", control.d_gains, "N m s/rad"),
    ]


def with_settings(parameters: Sequence[RandomParameter], rand: Any, draws: Mapping[str, Any]) -> list[RandomParameter]:
    """Return parameters as ``domain_rand`` asks for: those of ``keep_fixed`` keep their own values.

    Parameters without ranges of their own in ``draws`` go with the one whose draws they take. Bounds hold only where
    anything is drawn; a UserError if solrefs would mix their two formats there.
    """
    kept = []
    for parameter in parameters:
        setting = parameter.name if parameter.name in draws else parameter.same_draw_as or parameter.name
        is_kept = setting in rand.keep_fixed or (rand._swept and setting not in rand._swept)
        if isinstance(parameter.field, str) and parameter.bounds == Limits():
            parameter = dataclasses.replace(parameter, bounds=BOUNDS.get(parameter.field, Limits()))
        kept.append(fixed(parameter) if is_kept else parameter)
    if rand.randomize_parameters:
        _refuse_mixed_solrefs([parameter for parameter in kept if parameter.name in CONTACT])
        return kept
    return [dataclasses.replace(parameter, bounds=Limits()) for parameter in kept]


def _refuse_mixed_solrefs(drawn: Sequence[RandomParameter]) -> None:
    """Raise a UserError if one of :data:`CONTACT` is set, and the robot's own value of the other is of another format.

    MuJoCo reads two positive numbers as a time constant and a damping ratio, and has no meaning for a mixture.
    """
    are_set = [parameter.name for parameter in drawn if "set" in parameter.draw]
    are_kept: Any = [parameter for parameter in drawn if parameter.name not in are_set]
    if are_set and any(number > 0.0 for parameter in are_kept for number in parameter.own):
        raise UserError(
            f"domain_rand draws {are_set[0]} in MuJoCo's direct format of solref, and the robot's own "
            f"{are_kept[0].name} is of the other one: set ranges of both, or keep both fixed"
        )


def mirrors(randomization: Randomization, is_random: bool) -> dict[str, Mirroring | None]:
    """Return the mirror images of the numbers of :attr:`Randomization.values`, by name.

    None where it is not known, unless the numbers never change, or where it leaves their range: signed numbers need
    ranges around the robot's own value. ``is_random`` says whether anything will be drawn.
    """
    named, images, place = {p.name: p for p in randomization.parameters}, dict[str, Mirroring | None](), 0
    for name, size in randomization.sizes.items():
        parameter, at_start = named[name], randomization.values[0, place : place + size].cpu().numpy()
        place += size
        image = parameter.mirror
        if image is None and (size == 1 or not (is_random and parameter.is_drawn)):
            image = Mirroring.of_signs(*[1.0] * size)
        if image and len(image.order) != size:
            raise UserError(f"the mirror image of the random parameter '{name}' must have {size} numbers")
        leaves = image and min(image.signs) < 0.0 and image.unlike(at_start, [name] * size)
        images[name] = None if leaves else image
    return images


def entries(width: int, rows: Sequence[int]) -> list[int]:
    """Return the places of all numbers of some entries that have ``width`` numbers each."""
    return [row * width + part for row in rows for part in range(width)]
