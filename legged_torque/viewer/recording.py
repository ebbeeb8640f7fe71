"""What a viewer shows of a running task: torques by part, reward terms, and the last seconds of one world."""

from __future__ import annotations

import threading
from dataclasses import dataclass

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
        qpos: Positions of all worlds, see the simulator. Shape: (num_envs, nq).
        commands: Commands of all worlds that held during the step [m/s, m/s, rad/s]. Shape: (num_envs, 3).
        velocities: The same that the trunks do, in their own frames. Shape: (num_envs, 3).
        torques: Applied torques of the world that is followed, in its last physics step [N m]. Shape: (num_dof,).
        torque_parts: Its torques of PD control and of torque actions, before the limits [N m]. Shape: (2, num_dof).
        rewards: Its weighted reward terms of this step, per second. Shape: (terms,).
        resets: Worlds whose episode ended: [those that fell or diverged, those whose time was over].
    """

    qpos: np.ndarray
    commands: np.ndarray
    velocities: np.ndarray
    torques: np.ndarray
    torque_parts: np.ndarray
    rewards: np.ndarray
    resets: np.ndarray


class TorqueParts:
    """Keeps which part of the torques comes from PD control and which from torque actions.

    It wraps the task's ``_compute_torques``; what it keeps is written in place, so that it works in a CUDA graph too.

    Attributes:
        parts: Torques of PD control and of torque actions, weighted and times the motors' strength, before the limits
            [N m]; they sum to the torques that are applied, unless a limit clips those. Shape: (2, num_envs, num_dof).
    """

    def __init__(self, task: LeggedRobot) -> None:
        """Record from the next step of ``task`` on. In a task without PD control the first part stays 0."""
        self._task = task
        self._compute = task._compute_torques
        self._is_mixed = hasattr(task, "mixing")
        self._is_position = type(task)._compute_torques is LeggedRobot._compute_torques
        self.parts = torch.zeros(2, task.num_envs, task.num_dof, device=task.device)
        task._compute_torques = self._record

    def _record(self, actions: Tensor) -> Tensor:
        """Return the task's torques and keep their parts. Shapes: (num_envs, num_actions), (num_envs, num_dof)."""
        task, total = self._task, self._compute(actions)
        if self._is_mixed:
            pd = task.mixing[0] * task._pd_torques(actions[:, : task.num_dof])
        else:
            pd = total if self._is_position else torch.zeros_like(total)
        self.parts.copy_(torch.stack([pd, total - pd]) * task.motors.strength)
        return total


class Recorder:
    """Reads a task after each of its steps, in one transfer from the device."""

    def __init__(self, task: LeggedRobot) -> None:
        """Prepare, before the first step."""
        self._task = task
        self._parts = TorqueParts(task)
        self._sums = task.episode_sums.clone()
        self._commands = task.commands.clone()

    def before_step(self) -> None:
        """Keep what the step will overwrite."""
        self._commands.copy_(self._task.commands)
        self._sums.copy_(self._task.episode_sums)

    def read(self, world: int) -> Reading:
        """Return what the last step did.

        Args:
            world: The world that is followed.
        """
        task = self._task
        velocities = task.planar_velocity()
        before = torch.where(task.reset_buf, 0.0, self._sums)
        rewards = (task.episode_sums - before)[:, world] / task.dt
        timeouts = task.time_out_buf.sum()
        parts = [
            task.sim.qpos,
            self._commands,
            velocities,
            task.torques[world],
            self._parts.parts[:, world],
            rewards,
            torch.stack([task.reset_buf.sum() - timeouts, timeouts]),
        ]
        flat = torch.cat([part.reshape(-1).float() for part in parts]).cpu().numpy()
        ends = np.cumsum([part.numel() for part in parts])
        arrays = np.split(flat, ends[:-1])
        return Reading(*(array.reshape(tuple(part.shape)) for array, part in zip(arrays, parts, strict=True)))


class History:
    """The last seconds of one world, as one row of numbers per step; may be read from other threads."""

    def __init__(self, steps: int = HISTORY_STEPS) -> None:
        """Start empty.

        Args:
            steps: Rows to keep.
        """
        self._steps = steps
        self._lock = threading.Lock()
        self._rows: list[np.ndarray] = []

    def add(self, reading: Reading, world: int, time: float) -> None:
        """Append a step.

        Args:
            reading: What it did.
            world: The world that is followed.
            time: Simulated time [s].
        """
        parts = (reading.commands[world], reading.velocities[world], reading.torques, reading.torque_parts.reshape(-1))
        row = np.concatenate([[time], *parts])
        with self._lock:
            self._rows.append(row)
            del self._rows[: -self._steps]

    def clear(self) -> None:
        """Forget everything, for another world or task."""
        with self._lock:
            self._rows.clear()

    def read(self, num_dof: int) -> dict[str, np.ndarray]:
        """Return what is kept, oldest first.

        Args:
            num_dof: Number of joints.

        Returns:
            "time" [s], shape (steps,); "commands" and "velocities", shape (steps, 3); "torques", "pd" and "direct"
            [N m], shape (steps, num_dof).
        """
        with self._lock:
            rows = list(self._rows)
        table = np.array(rows).reshape(len(rows), 7 + 3 * num_dof)
        torques, pd, direct = np.split(table[:, 7:], 3, axis=1)
        return {
            "time": table[:, 0],
            "commands": table[:, 1:4],
            "velocities": table[:, 4:7],
            "torques": torques,
            "pd": pd,
            "direct": direct,
        }
