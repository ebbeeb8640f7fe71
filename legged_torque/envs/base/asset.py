"""From the settings of a robot to its model, its parts by name, and its numbers by joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged_torque import resource_path
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.sim.model import FLOOR, build_model, collision_geoms, indices_matching, read_spec
from legged_torque.terrain.terrain import Terrain
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.mjcf import loading


@dataclass
class Asset:
    """A robot's model and which of its parts mean what."""

    mj_model: mujoco.MjModel
    dof_names: list[str]  # of the joints, in the order of the MJCF
    geom_names: list[str]  # of the collision geoms; the lists below are places in this one
    feet: list[int]  # in the order of ``foot_names``
    penalized: list[int]  # geoms of the collision term
    terminating: list[int]  # geoms that end an episode

    @property
    def foot_names(self) -> list[str]:
        """Names of the geoms of the feet."""
        return [self.geom_names[place] for place in self.feet]

    def dof_axes(self) -> np.ndarray:
        """Return the axes of the joints in the frames of their bodies. Shape: (num_dof, 3)."""
        return self.mj_model.jnt_axis[1:]


def load_asset(cfg: LeggedRobotCfg, terrain: Terrain | None = None) -> Asset:
    """Load the robot of ``cfg.asset``, to be simulated in steps of ``cfg.sim.dt``, on the file's plane or a terrain.

    A UserError if the file cannot be read, a name in the settings matches nothing, or motors are in another order.
    """
    settings = cfg.asset
    spec = read_spec(resource_path(settings.file))
    _check_parts(spec, settings.file)
    geoms = collision_geoms(spec)
    feet = indices_matching(geoms, [settings.foot_name])
    penalized = indices_matching(geoms, settings.penalize_contacts_on)
    terminating = indices_matching(geoms, settings.terminate_after_contacts_on)
    if terrain:
        terrain.add_to(spec, FLOOR)
    with loading(resource_path(settings.file)):
        model = build_model(spec, geoms)
    if not np.isfinite([*model.body_mass, *model.body_inertia.flat]).all():
        raise UserError(f"'{settings.file}' has a mass or an inertia that is not finite")
    model.opt.timestep = cfg.sim.dt
    dof_names = [model.joint(i).name for i in range(1, model.njnt)]
    _check_motors(model, dof_names, settings.file)
    return Asset(model, dof_names, geoms, feet, penalized, terminating)


def _check_parts(spec: mujoco.MjSpec, file: str) -> None:
    """Refuse a robot that does not float, or does not stand on a floor of that name, beside which nothing collides."""
    trunks = [body for body in spec.worldbody.bodies if any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in body.joints)]
    if len(trunks) != 1:
        raise UserError(f"'{file}' must have one body with a free joint, the trunk, not {len(trunks)}")
    if FLOOR not in [geom.name for geom in spec.worldbody.geoms]:
        raise UserError(f"'{file}' must have a geom '{FLOOR}' in its worldbody")


def _check_motors(model: mujoco.MjModel, dof_names: list[str], file: str) -> None:
    """Refuse motors in another order than joints, whose torques would go to other joints, and motors without limits."""
    driven = [model.joint(joint).name for joint in model.actuator_trnid[:, 0]]
    if driven != dof_names:
        raise UserError(f"the motors of '{file}' must be in the order of its joints, {dof_names}, not {driven}")
    for actuator, name in enumerate(driven):
        if not model.actuator_forcelimited[actuator]:
            raise UserError(f"the motor of the joint '{name}' in '{file}' has no forcerange: its torque limits")


def by_joint(setting: str, values: float | dict[str, float], dof_names: Sequence[str]) -> list[float]:
    """Return a number for each joint: one for all, or by a part of their names, of which the first that matches counts.

    A UserError, which names the setting, if a joint has no number or a name matches no joint.
    """
    if not isinstance(values, dict):
        return [values] * len(dof_names)
    for part in values:
        if not any(part in name for name in dof_names):
            raise unknown_name(f"joint (part of its name) in {setting}", part, dof_names)
    result = []
    for name in dof_names:
        matching = [value for part, value in values.items() if part in name]
        if not matching:
            raise UserError(f"{setting} lacks the joint '{name}'; it has {', '.join(values) or 'no entries'}")
        result.append(matching[0])
    return result


def nominal_pose(angles: dict[str, float], dof_names: Sequence[str]) -> list[float]:
    """Return the angles [rad] of ``init_state.default_joint_angles``, in the order of the MJCF.

    A UserError if a joint is missing or unknown, or the order is another one.
    """
    key = "init_state.default_joint_angles"
    for name in angles:
        if name not in dof_names:
            raise unknown_name(f"joint in {key}", name, dof_names)
    for name in dof_names:
        if name not in angles:
            raise UserError(f"{key} lacks the joint '{name}'")
    if list(angles) != list(dof_names):
        raise UserError(f"{key} must be in the order of the MJCF's joints: {', '.join(dof_names)}")
    return list(angles.values())
