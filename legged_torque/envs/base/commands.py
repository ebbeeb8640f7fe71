"""Commanded velocities."""

import math
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from legged_torque.envs.base.commands_config import CommandsCfg
from legged_torque.envs.base.curriculum import RangeCurriculum
from legged_torque.sim import kernels
from legged_torque.utils.buffers import InPlace
from legged_torque.utils.errors import UserError
from legged_torque.utils.math import yaw

HEADING_GAIN = 0.5
"""Commanded yaw rate per angle that is left to a heading [1/s], as in legged_gym."""


class UniformCommands(InPlace):
    """Draws commands uniformly, from ranges that may grow; a share of the robots is to stand.

    Inherit for a generator of your own, and override :meth:`draw`, or :meth:`follow` for commands that change with
    time. Both run inside a step and obey the rules of :class:`~legged_torque.envs.base.base_task.BaseTask`: they write
    ``values`` in place. Register tensors of your own with ``task.keep``, and checkpoints contain them.

    Attributes:
        settings: The section ``commands``.
        task: The task; its ``state`` exists already.
        values: Commanded v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame. Shape: (num_envs, 3).
        headings: Where trunks shall turn to with ``commands.heading_command`` [rad]. Shape: (num_envs,).
        is_new: Worlds in which the last step drew a command. Shape: (num_envs,), bool.
        low, span: Lowest v_x, v_y, yaw rate and heading, and the widths of their ranges. Shapes: (4,).
        curriculum: What lets the ranges of velocities grow, with ``commands.curriculum``.
    """

    def __init__(self, settings: CommandsCfg, task: Any) -> None:
        """Start with commands of 0, or with ``commands.fixed``; they will be those of the task's state."""
        ranges, device = settings.ranges, task.device
        self.settings, self.task, self.values = settings, task, task.state.commands
        self.headings = torch.zeros_like(self.values[:, 0])
        self.is_new, self._stands = (torch.zeros_like(task.state.reset_buf) for _ in range(2))
        self._held, self._is_held = torch.zeros(3, device=device), torch.zeros((), dtype=torch.bool, device=device)
        limits = [ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw, ranges.heading]
        low, high = torch.tensor(limits, dtype=torch.float32, device=device).unbind(dim=1)
        self.low, self.span = low.clone(), high - low
        self.curriculum = None
        if settings.curriculum:  # headings have all of their range from the start
            velocities = self.low[:3], self.span[:3]
            self.curriculum = RangeCurriculum(settings.curriculum_start, *velocities, task.max_episode_length)
        if settings.fixed:
            self.hold(settings.fixed)
        self.hold_tensors()

    def hold(self, command: Sequence[float] | None) -> None:
        """Give all worlds one command of three numbers from the next step on; None draws new ones."""
        if command is not None and len(command) != len(self._held):
            raise UserError(f"a held command is v_x, v_y and a yaw rate, not {list(command)}")
        self._is_held.fill_(command is not None)
        if command is None:
            self.resample(torch.ones_like(self.is_new))
        else:
            self._held.copy_(torch.tensor(command))

    def resample(self, mask: Tensor) -> None:
        """Draw new commands in the worlds of ``mask``. Shape: (num_envs,), bool."""
        seeds = torch.empty_like(mask, dtype=torch.int32).random_()
        arrays = [wp.from_torch(array) for array in (mask, seeds, self.low, self.span, self.values, self.headings)]
        wp.launch(kernels.draw_commands, len(mask), arrays, device=arrays[0].device)
        self.update(mask)

    def update(self, drawn: Tensor | None = None) -> None:
        """Finish commands after the resets of a control step: :meth:`draw` in the worlds of ``drawn``, then follow.

        A held command replaces all. Shape: (num_envs,), bool.
        """
        if drawn is not None:
            self.draw(drawn)
        self.follow()
        self.values.copy_(torch.where(self._is_held, self._held, self.values))

    def draw(self, mask: Tensor) -> None:
        """Change the commands in the worlds of ``mask``, which have just been drawn uniformly.

        This one sets small commands to 0 and chooses robots that stand. Shape: (num_envs,), bool.
        """
        settings, planar = self.settings, self.values[:, :2]
        if settings.zero_below:
            is_slow = mask & (planar.norm(dim=1) < settings.zero_below)
            planar.masked_fill_(is_slow.unsqueeze(1), 0.0)
        if settings.standing_share:
            stands = torch.rand_like(self.headings) < settings.standing_share
            self._stands.copy_(torch.where(mask, stands, self._stands))

    def follow(self) -> None:
        """Change commands over time, at every step: yaw rates that turn to headings, and 0 for robots that stand.

        A yaw rate is proportional to the angle that is left to the heading, within the range of yaw rates.
        """
        if self.settings.heading_command:
            left = self.headings - yaw(self.task.state.base_quat)
            left = torch.remainder(left + math.pi, 2.0 * math.pi) - math.pi
            self.values[:, 2].copy_((HEADING_GAIN * left).clamp(self.low[2], self.low[2] + self.span[2]))
        if self.settings.standing_share:
            self.values.masked_fill_(self._stands.unsqueeze(1), 0.0)

    def add_step(self) -> None:
        """Add a control step to the curriculum, after its rewards and before its resets."""
        if self.curriculum:
            tracking = self.task._reward_tracking_lin_vel()
            self.curriculum.add_step(torch.where(self.task.state.diverged, 0.0, tracking))

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return the share of the ranges that commands are drawn from, for logging, if it changes."""
        return {"command_ranges": self.curriculum.share} if self.curriculum else {}

    def state_dict(self) -> dict[str, Any]:
        """Return what worlds keep; the commands are a part of the task's state."""
        stands = {"stands": self._stands} if self.settings.standing_share else {}
        ranges = {"ranges": self.curriculum.state_dict()} if self.curriculum else {}
        return {"headings": self.headings, **stands, **ranges}


def make_commands(task: Any) -> UniformCommands:
    """Return the generator that the settings of a task build; a UserError if it is none."""
    generator = task.cfg.commands.build(task)
    if not isinstance(generator, UniformCommands):
        raise UserError(f"commands.build must return UniformCommands or what inherits it, not {generator}")
    generator.hold_tensors()  # also those of a subclass
    return generator
