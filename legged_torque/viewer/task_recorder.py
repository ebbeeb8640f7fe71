"""Recording worlds of a task, to draw them afterwards."""

from __future__ import annotations

from pathlib import Path

import mujoco
import torch

from legged_torque import resource_path
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.viewer.video import Moment, write_video


class Recorder:
    """Keeps what some worlds do, to draw them as a video."""

    def __init__(self, task: LeggedRobot, num_worlds: int = 1) -> None:
        """Prepare.

        Args:
            task: What is recorded.
            num_worlds: How many worlds, from the first one on; 1 is the one with the fastest command at the start.
        """
        self._task = task
        self._num_worlds = num_worlds
        self._worlds: torch.Tensor | None = None
        self._steps: list[list[Moment]] = []

    def add_step(self) -> None:
        """Keep the state after a control step."""
        task = self._task
        if self._worlds is None:
            self._worlds = torch.arange(self._num_worlds, device=task.device)
            if self._num_worlds == 1:
                self._worlds = task.commands[:, :2].norm(dim=1).argmax().view(1)
        velocity = task.planar_velocity()
        parts = [part[self._worlds].double().cpu().numpy() for part in (task.sim.qpos, task.commands, velocity)]
        self._steps.append([Moment(*moment) for moment in zip(*parts, strict=True)])

    def save(self, file: Path) -> None:
        """Draw what was recorded, see :func:`~legged_torque.viewer.video.write_video`."""
        model = mujoco.MjModel.from_xml_path(str(resource_path(self._task.cfg.asset.file)))
        write_video(file, model, 1, self._steps, self._task.dt)
