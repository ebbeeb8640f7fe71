"""Standing up from random states: where such trials start, what counts as standing, and how often it works."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import torch
from torch import Tensor

from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.paper.gravity.dynamics import RobotDynamics
from legged_torque.terrain.selection import select_tiles
from legged_torque.utils.config import update_from_dict
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import apply_perturbation

Act = Callable[[LeggedRobot], Tensor]  # returns the actions for a task's state; (num_envs, num_actions)
START_CLEARANCE = (0.0, 0.02)  # lowest and highest clearance of the lowest foot at the start [m]
MAX_DRAWS = 20  # how often states are drawn until no other part of the robot is below the ground
LOWEST_HEIGHT = 0.2  # lowest height of a standing robot's trunk [m]
HIGHEST_GRAVITY_Z = -0.9
"""Highest z of the unit gravity vector in a standing robot's trunk frame: tilted by up to 26 degrees."""
HIGHEST_SPEED = 0.3  # highest speed of a standing robot's trunk [m/s]


@dataclass
class StandingResult:
    """How a trial went."""

    standing: Tensor  # which worlds stand at the end and have not fallen before. Shape: (num_envs,), bool
    share: float  # of these worlds
    mean_torque: float  # mean absolute torque over joints, time and worlds that have not fallen [N m]


def use_standing_trials(cfg: LeggedRobotCfg, decimation: int = 1) -> None:
    """Change a task's settings such that episodes start from the random states of ``--perturbation low``.

    Parameters are not random, nobody pushes, sensors have no noise, and rough ground is level. A control step has as
    many physics steps as ``decimation`` says: 1 for a controller at 200 Hz, 4 for a policy at 50 Hz.
    """
    apply_perturbation(cfg, "low")
    quiet = {"randomize_parameters": False, "push_robots": False}
    update_from_dict(cfg, {"domain_rand": quiet, "noise": {"add_noise": False}, "control": {"decimation": decimation}})
    if cfg.terrain.mesh_type == "heightfield":  # still a map, since policies may see it
        select_tiles(cfg.terrain, ["flat"], [0.0], 1)


def place_on_ground(
    task: LeggedRobot, dynamics: RobotDynamics, clearance: tuple[float, float] = START_CLEARANCE
) -> None:
    """Start an episode in every world, the lowest foot just above the ground, which is level at z = 0.

    The task draws its initial states; then trunks are moved up or down until the lowest point of the lowest foot has a
    random clearance [m]. States in which another collision geom would be below the ground are drawn again, at most
    :data:`MAX_DRAWS` times; what is left then is raised until that geom touches the ground. Waits for the host. A
    UserError if a collision geom is neither sphere, capsule nor box.
    """
    geoms = _LowestPoints(task, dynamics)
    qpos, qvel = torch.zeros_like(task.sim.qpos), torch.zeros_like(task.sim.qvel)
    missing = torch.ones(task.num_envs, dtype=torch.bool, device=task.device)
    for draw in range(MAX_DRAWS):
        task.reset()
        dynamics.update(task.sim.qpos, task.sim.qvel)
        foot, other = geoms()
        down = foot - torch.empty_like(foot).uniform_(*clearance)
        if draw == MAX_DRAWS - 1:
            down = torch.minimum(down, other)
        take = missing & (other >= down)
        task.base_pos[:, 2] -= down
        qpos = torch.where(take.unsqueeze(1), task.sim.qpos, qpos)
        qvel = torch.where(take.unsqueeze(1), task.sim.qvel, qvel)
        missing &= ~take
        if not missing.any():
            break
    task.set_state(qpos, qvel)


def is_standing(task: LeggedRobot) -> Tensor:
    """Return which worlds stand at the last physics step: high, level, slow, only on feet. Shape: (num_envs,), bool."""
    upright = (task.base_height > LOWEST_HEIGHT) & (task.projected_gravity[:, 2] < HIGHEST_GRAVITY_Z)
    only_feet = task.contacts.sum(dim=1) == task.feet_contact.sum(dim=1)
    slow = torch.linalg.vector_norm(task.base_lin_vel, dim=1) < HIGHEST_SPEED
    return upright & only_feet & slow  # falls before are not known here, see measure_standing


def actions_for(task: LeggedRobot, torques: Tensor) -> Tensor:
    """Return the actions that lead to torques in the present state of a task, see :class:`TorqueRobot`.

    Shapes: (num_envs, num_dof) [N m] to (num_envs, num_actions). A UserError if the task's actions are not torques.
    """
    if not isinstance(task, TorqueRobot):
        raise UserError(f"the actions of {type(task).__name__} are not torques, as those of TorqueRobot are")
    return task.actions_for(torques)


def check_torques(task: LeggedRobot) -> None:
    """Raise a UserError if a task cannot give any torques that are wanted of it."""
    wanted = torch.linspace(-5.0, 5.0, task.num_dof, device=task.device).expand_as(task.dof_pos)
    if not torch.allclose(task._compute_torques(actions_for(task, wanted)), wanted, atol=1e-3):
        raise UserError(f"{type(task).__name__} cannot give the torques that its actions_for is asked for")


def measure_standing(task: LeggedRobot, act: Act, duration: float) -> StandingResult:
    """Let a controller or policy act from the present state on, and see who stands in the end.

    Call :func:`place_on_ground` before. Worlds that the task resets, because the trunk touched the ground or the state
    diverged, have fallen. Which feet touch the ground is best told to ``act`` by ``task.feet_contact``. The duration
    [s] is shorter than an episode. A UserError if it is not.
    """
    steps = round(duration / task.dt)
    if steps >= task.max_episode_length:
        raise UserError(f"{duration} s do not fit into an episode of {task.max_episode_length * task.dt:g} s")
    upright = torch.ones(task.num_envs, dtype=torch.bool, device=task.device)
    total, count = (torch.zeros((), device=task.device) for _ in range(2))
    for _ in range(steps):
        task.step(act(task))
        upright &= ~task.reset_buf
        total += (task.torques.abs().mean(dim=1) * upright).sum()
        count += upright.sum()
    standing = upright & is_standing(task)
    return StandingResult(standing, standing.float().mean().item(), (total / count.clamp(min=1)).item())


class _LowestPoints:
    """Heights of the lowest points of feet and of all other collision geoms."""

    def __init__(self, task: LeggedRobot, dynamics: RobotDynamics) -> None:
        """Describe every geom as a rounded box: half sizes along its own axes, and a radius."""
        model = dynamics.mj_model
        names = [model.geom(i).name for i in range(model.ngeom)]
        feet = [names.index(name) for name in task.foot_names]
        others = [i for i in range(model.ngeom) if model.geom_bodyid[i] > 0 and i not in feet]
        shapes = [_rounded_box(model, i) for i in feet + others]
        self._half_sizes, self._radii = (
            torch.tensor(values, dtype=torch.float32, device=task.device) for values in zip(*shapes, strict=True)
        )
        self._geoms = torch.tensor(feet + others, device=task.device)
        self._sizes = [len(feet), len(others)]
        self._dynamics = dynamics

    def __call__(self) -> tuple[Tensor, Tensor]:
        """Return the heights [m] of the lowest foot and of the lowest other geom. Shapes: (n,)."""
        vertical = self._dynamics.geom_rotations[:, self._geoms, 2].abs()
        heights = self._dynamics.geom_positions[:, self._geoms, 2] - (vertical * self._half_sizes).sum(dim=2)
        feet, others = (heights - self._radii).split(self._sizes, dim=1)
        return feet.amin(dim=1), others.amin(dim=1)


def _rounded_box(model: mujoco.MjModel, geom: int) -> tuple[list[float], float]:
    """Return half sizes [m] and radius [m] of a geom; a UserError if it is neither sphere, capsule nor box."""
    kind, size = model.geom_type[geom], model.geom_size[geom].tolist()
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return [0.0, 0.0, 0.0], size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return [0.0, 0.0, size[1]], size[0]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return size, 0.0
    raise UserError(f"the collision geom '{model.geom(geom).name}' is neither sphere, capsule nor box")
