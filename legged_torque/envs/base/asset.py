"""A robot's model, its parts by name, and its numbers by joint, from its settings."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from legged_torque import resource_path
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.robot_checks import (
    floor_problems,
    foot_notes,
    mirror_problem,
    pose_problems,
    side_problem,
)
from legged_torque.envs.base.symmetry import RobotSymmetry
from legged_torque.sim.model import FLOOR, build_model, collision_geoms, indices_matching
from legged_torque.sim.robot_file import model_problems, spec_problems, use_plain_motors
from legged_torque.terrain.terrain import Terrain
from legged_torque.utils import mjcf
from legged_torque.utils.errors import UserError, check_names, collect_errors, refuse


@dataclass
class Asset:
    """A robot's model and the roles of its parts."""

    mj_model: mujoco.MjModel
    dof_names: list[str]  # of the joints, in the order of the settings, not of the MJCF
    geom_names: list[str]  # of the collision geoms; the lists below index this one
    feet: list[int]  # geoms of the feet, in the order of ``foot_names``
    penalized: list[int]  # geoms of the collision term
    terminating: list[int]  # geoms that end an episode
    notes: list[str]  # what a user should know of the robot, a line each

    @property
    def foot_names(self) -> list[str]:
        """Names of the geoms of the feet."""
        return [self.geom_names[place] for place in self.feet]

    @property
    def foot_of(self) -> list[int]:
        """Number of the foot that each geom of the feet belongs to; geoms of one body are one foot."""
        bodies = [int(self.mj_model.geom(name).bodyid[0]) for name in self.foot_names]
        return [list(dict.fromkeys(bodies)).index(body) for body in bodies]

    def dof_axes(self) -> np.ndarray:
        """Return the axes of the joints in the trunk's frame, all angles being 0. Shape: (num_dof, 3)."""
        return mjcf.joint_axes(self.mj_model)[1:]

    def symmetry(self, mirrored_legs: Sequence[Sequence[str]]) -> RobotSymmetry:
        """Return which joints and feet are mirror images of each other, given pairs of legs, right and left."""
        axes = self.dof_axes().tolist()
        symmetry = RobotSymmetry(mirrored_legs, self.dof_names, axes, self.foot_names, self.foot_of)
        if symmetry.joints and symmetry.foot_geoms:
            model, joints = self.mj_model, symmetry.joints
            problem = mirror_problem(model, joints, symmetry.foot_geoms, self.foot_names)
            symmetry.refuse(problem or side_problem(model, model.actuator_forcerange[:, 1], joints, self.dof_names))
        return symmetry


def load_asset(cfg: LeggedRobotCfg, terrain: Terrain | None = None) -> Asset:
    """Load the robot of ``cfg.asset``, to be simulated in steps of ``cfg.sim.dt``, on the file's plane or a terrain.

    Its motors are plain ones in the order of its joints, see :func:`~legged_torque.sim.robot_file.use_plain_motors`. A
    UserError, which lists all problems, if the file cannot be read, names in the settings match nothing, or tasks
    cannot simulate the robot.
    """
    settings, file = cfg.asset, resource_path(cfg.asset.file)
    spec = mjcf.read_spec(file, list(cfg.init_state.default_joint_angles))
    problems, notes, geoms = list(spec_problems(spec)), list(mjcf.drawing_notes(spec)), collision_geoms(spec)
    chosen: list[list[int]] = []
    for parts in ([settings.foot_name], settings.penalize_contacts_on, settings.terminate_after_contacts_on):
        with collect_errors(problems):
            chosen.append(indices_matching(geoms, parts))
    with mjcf.loading(file):
        if terrain and not problems:
            terrain.add_to(spec, FLOOR)
        model = spec.compile() if problems else build_model(spec, geoms)
    dof_names = [model.joint(i).name for i in range(1, model.njnt)]
    with collect_errors(problems):
        problems += model_problems(model)
        problems += pose_problems(nominal_pose(cfg.init_state.default_joint_angles, dof_names), model)
    if not problems:
        problems += floor_problems(model, [geoms[place] for place in chosen[0]])
    refuse(problems, f"'{settings.file}' cannot be simulated")
    use_plain_motors(spec, model)
    _choose_self_collisions(settings, spec, model, notes)
    with mjcf.loading(file):
        model = spec.compile()
    motors: Any = cfg.motors
    mjcf.set_joints(model, motors.of_joints(dof_names))
    model.opt.timestep = cfg.sim.dt
    feet, penalized, terminating = chosen
    notes += foot_notes(model, [geoms[place] for place in feet])
    return Asset(model, dof_names, geoms, feet, penalized, terminating, notes)


def _choose_self_collisions(
    settings: type[LeggedRobotCfg.asset], spec: mujoco.MjSpec, model: mujoco.MjModel, notes: list[str]
) -> None:
    """Exclude the robot's contacts with itself unless ``asset.self_collisions`` asks for them, and note that.

    A UserError if contacts were asked for and the file has none.
    """
    pairs = len(mjcf.self_pairs(model))
    if settings.self_collisions and not pairs:
        why = "no two geoms of its moving parts have contype and conaffinity that match, or are a <pair>"
        raise UserError(f"asset.self_collisions is on, but in '{settings.file}' {why}")
    if pairs and not settings.self_collisions:
        notes.append(f"{pairs} pairs of parts that could collide do not; asset.self_collisions=True lets them")
        mjcf.exclude_self_collisions(spec, model)


def nominal_pose(angles: dict[str, float], dof_names: Sequence[str]) -> list[float]:
    """Return the angles [rad] of ``init_state.default_joint_angles``, in the order of the model.

    A UserError if a joint is missing or unknown, or the order differs.
    """
    key = "init_state.default_joint_angles"
    check_names(f"joint in {key}", angles, dof_names)
    for name in dof_names:
        if name not in angles:
            raise UserError(f"{key} lacks the joint '{name}'")
    if list(angles) != list(dof_names):
        order = f"the order of {key}, in which policies see and drive them"
        raise UserError(f"the MJCF's joints cannot be put in {order}, by moving limbs: {', '.join(dof_names)}")
    return list(angles.values())
