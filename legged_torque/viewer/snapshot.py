"""A running task in the host's memory, read once after each control step."""

from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.metrics import WalkingMetrics
from legged_torque.sensors.height_scan import HeightScan
from legged_torque.terrain.rough import RoughGround

PD_CONTROL = "position_residual"  # name of the action term with joint positions as targets


@dataclass(frozen=True)
class Snapshot:
    """A task after a control step, and what users have changed since.

    Without another word, values are those of the followed world.
    """

    time: float  # simulated time since the session's start [s]
    world: int  # the followed world
    qpos: np.ndarray  # positions of all worlds, as sim.qpos; (num_envs, nq)
    commands: np.ndarray  # commands of all worlds during the step [m/s, m/s, rad/s]; (num_envs, 3)
    velocities: np.ndarray  # actual v_x, v_y and yaw rates of all worlds in the trunks' frames; (num_envs, 3)
    falls: int  # number of worlds whose episode ended other than by its time
    age: int  # control steps of the episode
    torques: np.ndarray  # applied in the last physics step [N m]; (num_dof,)
    torque_parts: np.ndarray  # the same by weighted action term, see WatchedRobot; (terms, num_dof)
    targets: np.ndarray  # joint positions wanted by PD control [rad]; (num_dof,), empty without PD control
    rewards: np.ndarray  # weighted reward terms of this step, per second; (terms,)
    metrics: dict[str, np.ndarray]  # numerator and denominator of each metric in this step, see WalkingMetrics; (2,)
    feet: np.ndarray  # 1 for each foot on the ground, else 0; (feet,)
    forces: np.ndarray  # of the ground on the collision geoms, in the world [N]; (geoms, 3)
    tile: tuple[int, int] | None  # level and column of the tile; None on a plane
    scan: np.ndarray  # points of the height scan on the ground [m]; (points, 3), empty on a plane


class WatchedRobot(LeggedRobot):
    """A task that records what viewers show; made by :func:`watched`.

    Attributes:
        torque_parts: Torques of each weighted action term, with its weight and the motors' strength, but before the
            limits [N m]; NaN for terms without a law. Shape: (terms, num_envs, num_dof).
    """

    def _init_state(self) -> None:
        """Allocate the parts, and prepare the height scan."""
        super()._init_state()
        self._watched_scan, self._metrics = HeightScan(self.cfg.terrain, self.state), WalkingMetrics(self)
        self._commands_before = self.commands.clone()
        self.torque_parts = torch.zeros(len(weighted_terms(self)), *self.dof_pos.shape, device=self.device)

    def _compute_torques(self, actions: Tensor) -> Tensor:
        """Return the task's torques and record their parts."""
        parts = iter(self.torque_parts)
        for term, own in zip(self.control_law.terms, actions.split(self.num_dof, dim=1), strict=True):
            if term.weight is not None:
                torques = term.torques(own.contiguous(), self.dof_pos, self.dof_vel) if term.law else own * torch.nan
                next(parts).copy_(term.weight * torques * self.motors.strength)
        return super()._compute_torques(actions)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Keep the commands, which a control step may draw anew at its end, make one, and measure it."""
        self._commands_before.copy_(self.commands)
        result = super().step(actions)
        self._metrics.clear()
        self._metrics.add_step(self._commands_before)
        return result

    def snapshot(self, time: float, world: int) -> Snapshot:
        """Return the result of the last step; for the arguments see :class:`Snapshot`."""
        tile, scan = None, self.commands[:0]
        if isinstance(self.terrain, RoughGround):
            tile = int(self.terrain.levels[world]), int(self.terrain.columns[world])
            scan = self._watched_scan.points()[world]
            scan[:, 2] = self.terrain.map.height(scan)
        ratios = self._metrics.ratios()
        names, targets = [term.name for term in self.control_law.terms], self.actions[:, :0]
        if PD_CONTROL in names:
            place = names.index(PD_CONTROL)
            scaled = self.control_law.terms[place].scale * self.actions.split(self.num_dof, dim=1)[place]
            targets = self.control.default_dof_pos + self.control.joint_offset + scaled
        tensors = {
            "qpos": self.sim.qpos,
            "commands": self._commands_before,
            "velocities": self.state.planar_velocity(),
            "torques": self.torques[world],
            "torque_parts": self.torque_parts[:, world],
            "targets": targets[world],
            "rewards": self.rewards.terms[:, world] / self.dt,
            "metrics": torch.stack([torch.stack(pair)[:, world] for pair in ratios.values()]),
            "feet": self.feet_contact[world],
            "forces": self.sim.contact_force[world],
            "scan": scan,
        }
        arrays = {name: tensor.cpu().numpy().copy() for name, tensor in tensors.items()}
        metrics = dict(zip(ratios, arrays.pop("metrics"), strict=True))
        falls, age = int((self.reset_buf & ~self.time_out_buf).sum()), int(self.episode_length_buf[world])
        return Snapshot(time, world, metrics=metrics, falls=falls, age=age, tile=tile, **arrays)


def watched(task_class: type[LeggedRobot]) -> type[WatchedRobot]:
    """Return a subclass of a task class that behaves the same and records what viewers show."""
    return cast(type[WatchedRobot], type(task_class.__name__, (WatchedRobot, task_class), {}))


def weighted_terms(task: LeggedRobot) -> dict[str, Tensor]:
    """Return the weights of the action terms that have one, by name. Writing to them changes the task."""
    return {term.name: term.weight for term in task.control_law.terms if term.weight is not None}
