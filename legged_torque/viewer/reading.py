"""What a viewer reads from a running task: torques by part, reward terms, and the last seconds of one world."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor

from legged_torque.envs.base.legged_robot import LeggedRobot

HISTORY_STEPS = 500
"""Control steps that :class:`History` keeps: 10 s."""


@dataclass(frozen=True)
class Reading:
    """A task after one control step, in the host's memory.

    Attributes:
        qpos: Positions of all worlds, as ``sim.qpos``. Shape: (num_envs, nq).
        commands: Commands of all worlds during the step [m/s, m/s, rad/s]. Shape: (num_envs, 3).
        velocities: Actual v_x, v_y and yaw rates, in the trunks' frames. Shape: (num_envs, 3).
        torques: Applied torques of the followed world in its last physics step [N m]. Shape: (num_dof,).
        torque_parts: See :attr:`WatchedRobot.torque_parts`, of the followed world. Shape: (parts, num_dof).
        rewards: Its weighted reward terms of this step, per second. Shape: (terms,).
        resets: Number of worlds whose episode ended: [fallen or diverged, timed out].
    """

    qpos: np.ndarray
    commands: np.ndarray
    velocities: np.ndarray
    torques: np.ndarray
    torque_parts: np.ndarray
    rewards: np.ndarray
    resets: np.ndarray


class WatchedRobot(LeggedRobot):
    """A task that keeps how much each weighted action term adds to the torques; made by :func:`watched`.

    Attributes:
        torque_parts: Torques of each action term that has a weight, times the motors' strength, before the limits
            [N m]. Shape: (parts, num_envs, num_dof).
    """

    def _init_actions(self) -> None:
        """Allocate the parts as well."""
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
    return {term.name: term.weight for term in task.action_terms() if term.weight is not None}


class TaskReader:
    """Reads a task after each of its steps, in one transfer from the device."""

    def __init__(self, task: WatchedRobot) -> None:
        """Prepare, before the first step."""
        self._task = task
        self._sums = task.episode_sums.clone()
        self._commands = task.commands.clone()

    def before_step(self) -> None:
        """Keep what the step will overwrite."""
        self._commands.copy_(self._task.commands)
        self._sums.copy_(self._task.episode_sums)

    def read(self, world: int) -> Reading:
        """Return what the last step did.

        Args:
            world: The followed world.
        """
        task = self._task
        before = torch.where(task.reset_buf, 0.0, self._sums)
        rewards = (task.episode_sums - before)[:, world] / task.dt
        timeouts = task.time_out_buf.sum()
        parts = [
            task.sim.qpos,
            self._commands,
            task.planar_velocity(),
            task.torques[world],
            task.torque_parts[:, world],
            rewards,
            torch.stack([task.reset_buf.sum() - timeouts, timeouts]),
        ]
        flat = torch.cat([part.reshape(-1).float() for part in parts]).cpu().numpy()
        ends = np.cumsum([part.numel() for part in parts])
        arrays = np.split(flat, ends[:-1])
        return Reading(*(array.reshape(tuple(part.shape)) for array, part in zip(arrays, parts, strict=True)))


class History:
    """The last seconds of one world; may be read from other threads."""

    def __init__(self, steps: int = HISTORY_STEPS) -> None:
        """Start empty.

        Args:
            steps: Steps to keep.
        """
        self._lock = threading.Lock()
        self._steps: deque[dict[str, np.ndarray | float]] = deque(maxlen=steps)

    def add(self, reading: Reading, world: int, time: float) -> None:
        """Append a step.

        Args:
            reading: The step.
            world: The followed world.
            time: Simulated time [s].
        """
        step = {
            "time": time,
            "commands": reading.commands[world],
            "velocities": reading.velocities[world],
            "torques": reading.torques,
            "torque_parts": reading.torque_parts,
        }
        with self._lock:
            self._steps.append(step)

    def clear(self) -> None:
        """Forget everything, for another world or task."""
        with self._lock:
            self._steps.clear()

    def read(self) -> dict[str, np.ndarray]:
        """Return the steps, oldest first; an empty dictionary if there are none.

        Returns:
            "time" [s], shape (steps,); "commands" and "velocities", shape (steps, 3); "torques" [N m], shape
            (steps, num_dof); "torque_parts" [N m], shape (steps, parts, num_dof).
        """
        with self._lock:
            steps = list(self._steps)
        return {name: np.array([step[name] for step in steps]) for name in (steps[0] if steps else ())}
