"""Which numbers of the robot, the ground and the controller are drawn at random (paper, App. I-B)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import torch
from torch import Tensor

from legged_torque.sim.randomization import Parameter, Range
from legged_torque.utils.errors import UserError
from legged_torque.utils.mirroring import SCALAR, VECTOR, Mirroring
from legged_torque.utils.mjcf import joint_limits

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot

TRUNK = 1  # the trunk's body
_ROUND = {int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)}  # types of feet that have a radius
LEAST_MASS = 0.01  # [kg] of a trunk


def initial_state(task: LeggedRobot) -> list[Parameter]:
    """Return what is drawn at the start of an episode: its state, the trunk's orientation as angles, and the delay."""
    rand, pose = task.cfg.domain_rand, task.default_dof_pos.tolist()
    qpos, qvel, dofs = task.sim.qpos, task.sim.qvel, range(task.num_dof)
    limits = joint_limits(task.sim.mj_model)[1:].T.tolist()
    shortest, longest = rand.action_delay
    pos = task.cfg.init_state.pos

    def velocity(name: str, columns: Any) -> Parameter:
        return Parameter(name, qvel, list(columns), base=0.0, offset=pair(getattr(rand, name)))

    delay: dict[str, Any] = {"base": 0.0, "offset": (shortest, longest + 1), "limits": ([shortest], [longest + 0.5])}
    dof_pos: dict[str, Any] = {"base": pose, "scale": pair(rand.init_dof_pos_scale), "limits": limits}
    return [
        Parameter("base_height", qpos, [2], base=pos[2]),
        Parameter("roll", task.init_angles, [0], base=0.0, offset=pair(rand.init_roll)),
        Parameter("pitch", task.init_angles, [1], base=0.0, offset=pair(rand.init_pitch)),
        Parameter("yaw", task.init_angles, [2], base=0.0, offset=pair(rand.init_yaw)),
        Parameter("dof_pos", qpos, [7 + dof for dof in dofs], **dof_pos),
        velocity("init_lin_vel", range(3)),
        velocity("init_ang_vel", range(3, 6)),
        velocity("init_dof_vel", [6 + dof for dof in dofs]),
        Parameter("action_delay", task.action_delay.drawn, [0], **delay),
        Parameter("init_place", qpos, range(2), base=pos[:2], offset=pair(rand.init_place)),
    ]


def parameters(task: LeggedRobot) -> list[Parameter]:
    """Return everything that ``cfg.domain_rand`` draws."""
    return [*robot_parameters(task), *ground_parameters(task), *control_parameters(task)]


def robot_parameters(task: LeggedRobot) -> list[Parameter]:
    """Return what is drawn of the robot; its joints may keep their own values, all at once."""
    cfg, model, symmetry = task.cfg.domain_rand, task.sim.mj_model, task.symmetry
    dofs, joints = range(6, model.nv), range(1, model.njnt)
    feet = [model.geom(name).id for name in task.foot_names]
    trunk = offset(cfg, "trunk_mass_offset") | scale(cfg, "trunk_mass_scale")
    inertia_per_mass = list(model.body_inertia[TRUNK] / model.body_mass[TRUNK])
    joint_values = symmetry.joints and symmetry.joints.unsigned()
    foot_vectors = symmetry.foot_geoms and symmetry.foot_geoms.of_vectors(VECTOR)

    def of_joints(name: str, field: str, columns: Any, share: dict[str, Any]) -> Parameter:
        drawn = absolute(cfg, name) or share
        return of_model(task, name, field, columns, may_keep=True, mirror=joint_values, **drawn)

    def added(name: str, unit: Tensor) -> dict[str, Any]:
        return offset(cfg, f"{name}_share") | {"weight": unit.tolist()}

    trunk_com = offset(cfg, "trunk_com_offset") | {"shared": True, "listed_by_column": True, "mirror": VECTOR}
    foot_offset = offset(cfg, "foot_offset")
    are_round = set(model.geom_type[feet]) <= _ROUND
    foot_radius = absolute(cfg, "foot_radius") or (scale(cfg, "foot_radius_share") if are_round else {})
    inertia = {**trunk, "weight": inertia_per_mass, "shared": True, "same_draw_as": "trunk_mass"}
    return [
        of_model(task, "trunk_mass", "body_mass", [TRUNK], **trunk, **at_least(cfg, LEAST_MASS)),
        of_model(task, "trunk_inertia", "body_inertia", entries(3, [TRUNK]), **inertia),
        of_model(task, "trunk_com", "body_ipos", entries(3, [TRUNK]), **trunk_com),
        of_model(task, "foot_radius", "geom_size", [3 * foot for foot in feet], shared=True, **foot_radius),
        of_model(task, "foot_offset", "geom_pos", entries(3, feet), mirror=foot_vectors, **foot_offset),
        of_joints("dof_damping", "dof_damping", dofs, added("dof_damping", task.d_gains[0])),
        of_joints("dof_armature", "dof_armature", dofs, scale(cfg, "dof_armature_share")),
        of_joints("dof_stiffness", "jnt_stiffness", joints, added("dof_stiffness", task.p_gains[0])),
        of_joints("dof_frictionloss", "dof_frictionloss", dofs, added("dof_frictionloss", task.torque_limits[1])),
    ]


def ground_parameters(task: LeggedRobot) -> list[Parameter]:
    """Return what is drawn of the ground; it is the same for all geoms of a world."""
    cfg, model = task.cfg.domain_rand, task.sim.mj_model
    geoms = [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
    kinds = list((model.geom_friction[geoms] / model.geom_friction[geoms, :1]).ravel())
    friction, stiffness = absolute(cfg, "ground_friction", kinds), absolute(cfg, "contact_stiffness", -1.0)
    damping = absolute(cfg, "contact_damping", -1.0) | {"same_draw_as": "contact_stiffness"}
    return [
        of_model(task, "ground_friction", "geom_friction", entries(3, geoms), shared=True, **friction),
        of_model(task, "contact_stiffness", "geom_solref", [2 * geom for geom in geoms], shared=True, **stiffness),
        of_model(task, "contact_damping", "geom_solref", [2 * geom + 1 for geom in geoms], shared=True, **damping),
        of_model(task, "gravity", "gravity", [2], **absolute(cfg, "gravity", -1.0)),
    ]


def control_parameters(task: LeggedRobot) -> list[Parameter]:
    """Return what is drawn of the controller: numbers for all joints, offsets and further factors of each joint."""
    cfg, control = task.cfg.domain_rand, task.cfg.control
    joints, mirror = range(task.num_dof), task.symmetry.joints
    action_scale = offset(cfg, "action_scale_offset")
    torque_scale = action_scale | {"weight": control.torque_scale / control.action_scale}
    strength = scale(cfg, "motor_strength")
    stiffness = offset(cfg, "stiffness_offset") | scale(cfg, "stiffness_scale") | at_least(cfg, 0.0)
    damping = offset(cfg, "damping_offset") | scale(cfg, "damping_scale") | at_least(cfg, 0.0)

    def of_joints(name: str, factor: str, field: Tensor, drawn: dict[str, Any]) -> Parameter:
        own = getattr(cfg, f"{factor}_per_joint")
        if own is not None:
            drawn |= {"column_scale": pair(own) if is_drawn(cfg, f"{factor}_per_joint") else (1.0, 1.0)}
            drawn |= {"mirror": mirror and mirror.unsigned()}
        return Parameter(name, field, joints, shared=True, **drawn)

    return [
        of_joints("motor_strength", "motor_strength", task.motors.strength, strength),
        Parameter("joint_offset", task.joint_offset, joints, mirror=mirror, **offset(cfg, "joint_offset")),
        Parameter("action_scale", task.action_scale, [0], **action_scale, **at_least(cfg, 0.0)),
        Parameter("torque_scale", task.torque_scale, [0], same_draw_as="action_scale", **torque_scale),
        of_joints("p_gains", "stiffness_scale", task.p_gains, stiffness),
        of_joints("d_gains", "damping_scale", task.d_gains, damping),
    ]


def mirrors(drawn: list[Parameter], sizes: dict[str, int]) -> dict[str, Mirroring | None]:
    """Return the mirror images of the numbers of :attr:`Randomization.values`, by name; None where it is not known.

    ``sizes`` says how many numbers of its own each of the drawn parameters has.
    """
    own = [parameter for parameter in drawn if parameter.name in sizes]
    for p in own:
        if p.mirror and len(p.mirror.order) != sizes[p.name]:
            raise UserError(f"the mirror image of the random parameter '{p.name}' must have {sizes[p.name]} numbers")
    return {p.name: p.mirror or (SCALAR if sizes[p.name] == 1 else None) for p in own}


def check_fields(task: LeggedRobot, drawn: list[Parameter]) -> None:
    """Refuse parameters in the model that do not name their field: what follows from it would stay as it was."""
    if not task.cfg.domain_rand.randomize_parameters:
        return
    fields = {field.untyped_storage().data_ptr(): name for name, field in task.sim.fields.items()}
    for parameter in drawn:
        name = fields.get(parameter.field.untyped_storage().data_ptr())
        if name != parameter.model_field:
            raise UserError(f"the random parameter '{parameter.name}' is kept in the model's '{name}': use of_model")


def of_model(task: LeggedRobot, name: str, field: str, columns: Sequence[int], **settings: Any) -> Parameter:
    """Return a parameter kept in a field of the model.

    ``columns`` are numbers of a world's part of the field, all of its entries flattened; ``settings`` is all else that
    a :class:`~legged_torque.sim.randomization.Parameter` takes. Without random parameters, worlds share the field.
    """
    if task.cfg.domain_rand.randomize_parameters:
        task.sim.check_columns(field, columns)
        values = task.sim.field(field)
    else:
        model = task.sim.mj_model
        shared = getattr(model.opt if field == "gravity" else model, field)
        values = torch.tensor(shared, dtype=torch.float32, device=task.device).unsqueeze(0)
    return Parameter(name, values.flatten(1), list(columns), model_field=field, **settings)


def entries(width: int, rows: list[int]) -> list[int]:
    """Return the places of all numbers of some entries that have ``width`` numbers each."""
    return [row * width + part for row in rows for part in range(width)]


def pair(limits: Sequence[float]) -> Range:
    """Return a range of the settings as lowest and highest value."""
    low, high = limits
    return low, high


def is_drawn(cfg: Any, name: str) -> bool:
    """Return whether a parameter has a range and is not kept fixed, by this name or by that without ``_share``."""
    return getattr(cfg, name) is not None and not {name, name.removesuffix("_share")} & set(cfg.keep_fixed)


def offset(cfg: Any, name: str) -> dict[str, Any]:
    """Return settings for a value that is changed by an offset, unless it is kept fixed."""
    return {"offset": pair(getattr(cfg, name))} if is_drawn(cfg, name) else {}


def scale(cfg: Any, name: str) -> dict[str, Any]:
    """Return settings for a value that is multiplied, unless it is kept fixed."""
    return {"scale": pair(getattr(cfg, name))} if is_drawn(cfg, name) else {}


def at_least(cfg: Any, value: float) -> dict[str, Any]:
    """Return settings for a value that no draw may bring below another, where anything is drawn."""
    return {"at_least": value} if cfg.randomize_parameters else {}


def absolute(cfg: Any, name: str, weight: list[float] | float = 1.0) -> dict[str, Any]:
    """Return settings for a value that is replaced, times a weight, unless it is kept fixed."""
    if not is_drawn(cfg, name):
        return {}
    return {"base": 0.0, "offset": pair(getattr(cfg, name)), "weight": weight}
