"""Random events in the worlds of a task: resets, new commands, new parameters, pushes."""

import functools
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from legged_torque.envs.base.commands import UniformCommands
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.sim import kernels
from legged_torque.sim.engine import Engine, shared_field
from legged_torque.sim.randomization import Randomization, RandomParameter
from legged_torque.utils.errors import UserError

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
        sim: Engine,
        commands: UniformCommands,
        init_angles: Tensor,
        initial_state: Sequence[RandomParameter],
        parameters: Sequence[RandomParameter],
    ) -> None:
        """Prepare; nothing is drawn yet. ``init_angles`` are among the fields of ``initial_state``.

        A UserError if two parameters have one name: they would share their draws.
        """
        names = [parameter.name for parameter in (*initial_state, *parameters)]
        if twice := [name for name in names if names.count(name) > 1]:
            raise UserError(f"two random parameters are called '{twice[0]}'")
        settings = self._settings = cfg.domain_rand
        self._sim, self._commands, self.init_angles = sim, commands, init_angles
        device, n = sim.device, sim.num_envs
        self._new_parameters = torch.zeros(n, dtype=torch.bool, device=device)
        model_field = sim.field if settings.randomize_parameters else functools.partial(shared_field, sim)
        self.initial_state = Randomization(initial_state, model_field, n, device)
        self.parameters = Randomization(parameters, model_field, n, device, settings.keep_probability)
        self._seeds = torch.zeros(3, n, dtype=torch.int32, device=device)
        self.initial_state.seeds, self.parameters.seeds = self._seeds[1:]
        chances = [cfg.commands.resampling_probability, settings.resampling_probability]
        self._chances = wp.vec4(*chances, settings.push_probability * settings.push_robots, PUSH_ADDED)

    def apply(self, is_new: Tensor) -> None:
        """Begin episodes: draw states and delays, and clear what the simulator kept, in the worlds of ``is_new``.

        There, and where chance says so, draw commands and parameters; push where chance says so. Shape: (num_envs,),
        bool.
        """
        self._seeds.random_()
        self._sim.reset(is_new)
        self.initial_state.draw(is_new)
        commands, sim, settings = self._commands, self._sim, self._settings
        pushes = (wp.vec2(*settings.push_velocity), settings.push_set_factor)
        new, seeds = map(wp.from_torch, (is_new, self._seeds[0]))
        read = map(wp.from_torch, (self.init_angles, commands.low, commands.span))
        masks, drawn = (commands.is_new, self._new_parameters), (commands.values, commands.headings)
        written = map(wp.from_torch, (*masks, *drawn, sim.qpos, sim.qvel))
        arguments = [new, seeds, self._chances, *pushes, *read, *written]
        wp.launch(kernels.apply_random_events, sim.num_envs, arguments, device=seeds.device)
        if settings.randomize_parameters:
            self.parameters.draw(self._new_parameters)
            sim.update_constants(self._new_parameters)

    def state_dict(self) -> dict[str, Any]:
        """Return the drawn parameters, and the tensors in which they are kept; those of the model the simulator has."""
        return {"values": self.parameters.values, "fields": self.parameters.own_fields()}
