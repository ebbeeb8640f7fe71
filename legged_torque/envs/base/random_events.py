"""What happens at random in the worlds of a task: resets, new commands, new parameters, pushes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from legged_torque.envs.base.commands import UniformCommands
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.sim.randomization import Parameter, Randomization
from legged_torque.sim.simulator import Simulator

PUSH_ADDED = 0.5  # share of pushes that add a velocity; the others set one, times ``push_set_factor``


class RandomEvents:
    """Chooses worlds by mask; numbers are drawn for all and kept where they are due, since a step replays as a graph.

    Attributes:
        initial_state: What is drawn at resets.
        parameters: What is drawn at resets and at random.
        init_angles: Roll, pitch and yaw of the trunk at the last reset [rad]. Shape: (num_envs, 3).
    """

    def __init__(
        self,
        cfg: LeggedRobotCfg,
        sim: Simulator,
        commands: UniformCommands,
        init_angles: Tensor,
        initial_state: Sequence[Parameter],
        parameters: Sequence[Parameter],
    ) -> None:
        """Prepare; nothing is drawn yet. ``init_angles`` are among the fields of ``initial_state``."""
        settings = self._settings = cfg.domain_rand
        self._sim, self._commands, self.init_angles = sim, commands, init_angles
        device, n = sim.device, sim.num_envs
        chances = [cfg.commands.resampling_probability, settings.resampling_probability]
        chances += [settings.push_probability, PUSH_ADDED]
        self._probabilities = torch.tensor(chances, device=device).unsqueeze(1)
        self._push_velocity = torch.zeros(n, 3, device=device)
        self.initial_state = Randomization(initial_state, n, device)
        self.parameters = Randomization(parameters, n, device, settings.keep_probability)

    def reset_state(self, mask: Tensor) -> None:
        """Draw states and delays in the worlds of ``mask`` (num_envs,), bool, and clear what the simulator kept."""
        self._sim.reset(mask)
        self.initial_state.draw(mask)
        self._sim.set_orientation(mask, self.init_angles)

    def draw_parameters(self, mask: Tensor) -> None:
        """Draw parameters of robot, ground and controller anew in the worlds of ``mask``. Shape: (num_envs,), bool."""
        self.parameters.draw(mask)
        self._sim.update_constants(mask)

    def happen(self, is_new: Tensor) -> None:
        """Draw commands and parameters where an episode begins or chance says so, and push where chance says so.

        ``is_new`` (num_envs,), bool, says where an episode begins.
        """
        chosen = torch.rand(4, self._sim.num_envs, device=self._sim.device) < self._probabilities
        new_commands, new_parameters = chosen[:2] | is_new
        push, add = chosen[2:]
        self._commands.resample(new_commands)
        if self._settings.randomize_parameters:
            self.draw_parameters(new_parameters)
        if self._settings.push_robots:
            drawn = torch.empty_like(self._push_velocity).uniform_(*self._settings.push_velocity)
            where_set = self._settings.push_set_factor * drawn
            torch.where(add.unsqueeze(1), drawn, where_set, out=self._push_velocity)
            self._sim.push(push, self._push_velocity, add)
