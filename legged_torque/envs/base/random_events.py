"""What happens at random in the worlds of a task: resets, new commands, new parameters, pushes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from legged_torque.envs.base.commands import UniformCommands
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.sim import kernels
from legged_torque.sim.randomization import Parameter, Randomization
from legged_torque.sim.simulator import Simulator

PUSH_ADDED = 0.5  # share of pushes that add a velocity; the others set one, times ``push_set_factor``


class RandomEvents:
    """Chooses worlds by mask, since a step replays as a graph; torch generates new seeds for every world at a time.

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
        chances = (cfg.commands.resampling_probability, settings.resampling_probability, settings.push_probability)
        self._chances = wp.vec4(*chances, PUSH_ADDED)
        self._masks = torch.zeros(4, n, dtype=torch.bool, device=device).unbind()
        self._push_velocity = torch.zeros(n, 3, device=device)
        self.initial_state = Randomization(initial_state, n, device)
        self.parameters = Randomization(parameters, n, device, settings.keep_probability)
        self._seeds = torch.zeros(4, n, dtype=torch.int32, device=device)
        commands.seeds, self.initial_state.seeds, self.parameters.seeds = self._seeds[1:]

    def draw_commands(self, mask: Tensor) -> None:
        """Draw commands anew in the worlds of ``mask``. Shape: (num_envs,), bool."""
        self._seeds.random_()
        self._commands.resample(mask)

    def draw_parameters(self, mask: Tensor) -> None:
        """Draw parameters of robot, ground and controller anew in the worlds of ``mask``. Shape: (num_envs,), bool."""
        self._seeds.random_()
        self._write_parameters(mask)

    def happen(self, is_new: Tensor) -> None:
        """Begin episodes: draw states and delays, and clear what the simulator kept, in the worlds of ``is_new``.

        There, and where chance says so, draw commands and parameters; push where chance says so. Shape: (num_envs,),
        bool.
        """
        self._seeds.random_()
        new_commands, new_parameters, pushed, added = self._choose(is_new)
        self._sim.reset(is_new)
        self.initial_state.draw(is_new)
        self._sim.set_orientation(is_new, self.init_angles)
        self._commands.resample(new_commands)
        if self._settings.randomize_parameters:
            self._write_parameters(new_parameters)
        if self._settings.push_robots:
            self._sim.push(pushed, self._push_velocity, added)

    def _choose(self, is_new: Tensor) -> tuple[Tensor, ...]:
        """Return where commands and parameters are to be drawn, and where a push happens and where it adds."""
        pushes = (wp.vec2(*self._settings.push_velocity), self._settings.push_set_factor)
        seeds, new, *written = map(wp.from_torch, (self._seeds[0], is_new, *self._masks, self._push_velocity))
        arguments = [seeds, new, self._chances, *pushes, *written]
        wp.launch(kernels.choose, self._sim.num_envs, arguments, device=seeds.device)
        return self._masks

    def _write_parameters(self, mask: Tensor) -> None:
        """Draw parameters from their seeds, and what follows from them."""
        self.parameters.draw(mask)
        self._sim.update_constants(mask)
