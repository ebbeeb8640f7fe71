"""Trials of standing up from random states."""

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
from legged_torque.utils.standing import stands

Act = Callable[[TorqueRobot], Tensor]  # returns the actions for a task's state; (num_envs, num_actions)
START_CLEARANCE = (0.0, 0.02)  # lowest and highest clearance of the lowest foot at the start [m]
MAX_DRAWS = 20  # draws of a state until no other part of the robot is below the ground
HIGHEST_SPEED = 0.3  # of a standing robot's trunk [m/s]


@dataclass
class StandingResult:
    """The result of a trial."""

    standing: Tensor  # worlds that stand at the end and have not fallen before. Shape: (num_envs,), bool
    share: float  # of these worlds
    mean_torque: float  # mean absolute torque over joints, time and worlds that have not fallen [N m]


def use_standing_trials(cfg: LeggedRobotCfg, decimation: int = 1) -> None:
    """Change a task's settings such that episodes start from the random states of ``--perturbation low``.

    Parameters are not random, robots are not pushed, sensors have no noise, and rough ground is level. ``decimation``
    is the number of physics steps per control step: 1 for a controller at 200 Hz, 4 for a policy at 50 Hz.
    """
    apply_perturbation(cfg, "low")
    quiet = {"randomize_parameters": False, "push_robots": False}
    update_from_dict(cfg, {"domain_rand": quiet, "noise": {"add_noise": False}, "control": {"decimation": decimation}})
    if cfg.terrain.mesh_type == "heightfield":  # still a map, since policies may see it
        select_tiles(cfg.terrain, ["flat"], [0.0], 1)


def place_on_ground(task: LeggedRobot, dynamics: RobotDynamics) -> None:
    """Start an episode in every world, the lowest foot just above the ground, which is level at z = 0.

    The task draws its initial states; then trunks are moved up or down until the lowest point of the lowest foot has a
    random clearance (:data:`START_CLEARANCE`). States in which another collision geom would be below the ground are
    drawn again, at most :data:`MAX_DRAWS` times; those left over are raised until that geom touches the ground. Waits
    for the host.

    Raises:
        UserError: If a collision geom is neither sphere, capsule nor box.
    """
    lowest_points = _LowestPoints(task, dynamics)
    qpos, qvel = torch.zeros_like(task.sim.qpos), torch.zeros_like(task.sim.qvel)
    missing = torch.ones(task.num_envs, dtype=torch.bool, device=task.device)
    for draw in range(MAX_DRAWS):
        task.reset()
        dynamics.update(task.sim.qpos, task.sim.qvel)
        foot, other = lowest_points()
        down = foot - torch.empty_like(foot).uniform_(*START_CLEARANCE)
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
    tilt = torch.acos((-task.projected_gravity[:, 2]).clamp(-1.0, 1.0))
    only_feet = task.contacts.sum(dim=1) == task.contacts[:, task.feet_indices].sum(dim=1)
    slow = torch.linalg.vector_norm(task.base_lin_vel, dim=1) < HIGHEST_SPEED
    return stands(task.base_height, task.cfg.rewards.base_height_target, tilt) & only_feet & slow


def measure_standing(task: TorqueRobot, act: Act, duration: float) -> StandingResult:
    """Let a controller or policy act from the present state on, and count the worlds that stand at the end.

    Call :func:`place_on_ground` before. Worlds that the task resets, because the trunk touched the ground or the state
    diverged, have fallen. ``act`` finds the feet that touch the ground in ``task.feet_contact``.

    Raises:
        UserError: If the duration [s] is not shorter than an episode.
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
        feet = [model.geom(name).id for name in task.foot_names]
        others = [i for i in range(model.ngeom) if model.geom_bodyid[i] > 0 and i not in feet]
        half_sizes, radii = zip(*(_rounded_box(model, i) for i in feet + others), strict=True)
        self._half_sizes, self._radii = (torch.tensor(part, device=task.device) for part in (half_sizes, radii))
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
