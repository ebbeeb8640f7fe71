"""What a viewer reads from a running task after each step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.sensors.height_scan import HeightScan
from legged_torque.terrain.rough import RoughGround


@dataclass(frozen=True)
class Reading:
    """A task after one control step, in the host's memory."""

    time: float  # simulated time since the session's start [s]
    world: int  # the followed world
    qpos: np.ndarray  # positions of all worlds, as sim.qpos; (num_envs, nq)
    commands: np.ndarray  # commands of all worlds during the step [m/s, m/s, rad/s]; (num_envs, 3)
    velocities: np.ndarray  # actual v_x, v_y and yaw rates, in the trunks' frames; (num_envs, 3)
    torques: np.ndarray  # applied torques of the followed world in its last physics step [N m]; (num_dof,)
    torque_parts: np.ndarray  # those of WatchedRobot, of the followed world; (parts, num_dof)
    rewards: np.ndarray  # its weighted reward terms of this step, per second; (terms,)
    resets: np.ndarray  # number of worlds whose episode ended: [fallen or diverged, timed out]
    tile: np.ndarray  # level and column of the followed world's tile; empty on a plane
    scan: np.ndarray  # where its height scan meets the ground [m]; (points, 3), without any on a plane
    age: np.ndarray  # control steps of its episode; (1,)
    feet: np.ndarray  # 1 for each of its feet on the ground, else 0; (feet,)
    forces: np.ndarray  # of the ground on its collision geoms, in the world [N]; (geoms, 3)
    targets: np.ndarray  # its joint positions that PD control wants [rad]; (num_dof,), empty without PD control


class WatchedRobot(LeggedRobot):
    """A task that keeps how much each weighted action term adds to the torques; made by :func:`watched`."""

    def _init_actions(self) -> None:
        """Allocate the parts: times the motors' strength, before the limits [N m]. (parts, num_envs, num_dof)."""
        super()._init_actions()
        self.torque_parts = torch.zeros(len(weighted_terms(self)), self.num_envs, self.num_dof, device=self.device)

    def _compute_torques(self, actions: Tensor) -> Tensor:
        """Return the task's torques. The part of a term is what its weight of 0 would take away."""
        torques = super()._compute_torques(actions)
        for part, weight in zip(self.torque_parts, weighted_terms(self).values(), strict=True):
            kept = weight.clone()
            weight.zero_()
            part.copy_((torques - super()._compute_torques(actions)) * self.motors.strength)
            weight.copy_(kept)
        return torques


def watched(task_class: type[LeggedRobot]) -> type[WatchedRobot]:
    """Return a task class that behaves like the given one and keeps the parts of its torques."""
    return cast(type[WatchedRobot], type(task_class.__name__, (WatchedRobot, task_class), {}))


def weighted_terms(task: LeggedRobot) -> dict[str, Tensor]:
    """Return the weights of the action terms that have one, by the terms' names. Writing to them changes the task."""
    return {term.name: term.weight for term in task.control_law.terms if term.weight is not None}


class TaskReader:
    """Reads a task after each of its steps, in one transfer from the device."""

    def __init__(self, task: WatchedRobot) -> None:
        """Prepare, before the first step."""
        self._task = task
        self._sums = task.episode_sums.clone()
        self._commands = task.commands.clone()
        self._scan = HeightScan(task)

    def before_step(self) -> None:
        """Keep what the step will overwrite."""
        self._commands.copy_(self._task.commands)
        self._sums.copy_(self._task.episode_sums)

    def read(self, time: float, world: int) -> Reading:
        """Return what the last step did; arguments as of :class:`Reading`."""
        task = self._task
        before = torch.where(task.reset_buf, 0.0, self._sums)
        rewards = (task.episode_sums - before)[:, world] / task.dt
        timeouts = task.time_out_buf.sum()
        tile, scan = task.episode_sums.new_zeros(0), task.episode_sums.new_zeros(0, 3)
        if isinstance(task.terrain, RoughGround):
            tile = torch.stack([task.terrain.levels[world], task.terrain.columns[world]])
            scan = self._scan.points()[world]
            scan[:, 2] = task.terrain.height(scan)
        parts = [
            task.sim.qpos,
            self._commands,
            task.state.planar_velocity(),
            task.torques[world],
            task.torque_parts[:, world],
            rewards,
            torch.stack([task.reset_buf.sum() - timeouts, timeouts]),
            tile,
            scan,
            task.episode_length_buf[world : world + 1],
            task.feet_contact[world],
            task.sim.contact_force[world],
            self._targets(world),
        ]
        flat = torch.cat([part.reshape(-1).float() for part in parts]).cpu().numpy()
        arrays = np.split(flat, np.cumsum([part.numel() for part in parts])[:-1])
        shaped = [array.reshape(tuple(part.shape)) for array, part in zip(arrays, parts, strict=True)]
        return Reading(time, world, *shaped)

    def _targets(self, world: int) -> Tensor:
        """Return where PD control wants the joints of a world, see :class:`Reading`."""
        task = self._task
        for place, term in enumerate(task.control_law.terms):
            if term.name == "position_residual":
                actions = task.actions[world, place * task.num_dof :][: task.num_dof]
                return task.default_dof_pos + task.joint_offset[world] + term.scale[world] * actions
        return task.actions.new_zeros(0)
