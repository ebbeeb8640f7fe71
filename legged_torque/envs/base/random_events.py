"""What happens at random in a task: resets, commands, changes of parameters, pushes, errors of sensors."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_torque.envs.base.domain_rand import draws_legs, initial_state, parameters
from legged_torque.motors.action_delay import ActionDelay
from legged_torque.sim.randomization import Parameter, Randomization

PUSH_ADDED = 0.5
"""Share of pushes that add a velocity; the others set one."""


class RandomEvents:
    """Random events of :class:`~legged_torque.envs.base.legged_robot.LeggedRobot`, of which this is a part.

    Worlds are chosen by mask, and numbers are drawn for all worlds and kept where they are due, since a step replays
    as a CUDA graph.
    """

    def _reset_worlds(self) -> None:
        """Start a new episode in the worlds of ``reset_buf``; elsewhere draw anew what is due."""
        mask = self.reset_buf
        self._reset_state(mask)
        for buffer in (self.actions, self.feet_air_time):
            buffer.masked_fill_(mask.unsqueeze(1), 0.0)
        self.action_delay.reset(mask)
        self._episode_length_buf.masked_fill_(mask, 0)
        self.episode_sums.masked_fill_(mask, 0.0)
        self.episode_return.masked_fill_(mask, 0.0)
        rand = self.cfg.domain_rand
        happens = torch.rand(4, self.num_envs, device=self.device) < self._probabilities
        new_commands, new_parameters = happens[:2] | mask
        self._resample_commands(new_commands)
        if rand.randomize_parameters:
            self._randomize_parameters(new_parameters)
        push, add = happens[2:]
        if rand.push_robots:
            self._push_robots(push, add)
        self._update_state()

    def _init_random_events(self) -> None:
        """Allocate what the events need."""
        rand = self.cfg.domain_rand
        probabilities = [self.cfg.commands.resampling_probability, rand.resampling_probability, rand.push_probability]
        self._probabilities = self._tensor([*probabilities, PUSH_ADDED]).unsqueeze(1)
        self.action_delay = ActionDelay(self)
        self.init_angles = torch.zeros(self.num_envs, 3, device=self.device)
        self.initial_state = Randomization(initial_state(self), self.num_envs, self.device)
        drawn = self.random_parameters()
        self.randomization = Randomization(drawn, self.num_envs, self.device, rand.keep_probability)
        if rand.randomize_parameters and draws_legs(self, drawn):
            self.sim.vary_legs()

    def random_parameters(self) -> list[Parameter]:
        """Return what ``domain_rand`` draws in each world; a variant may add to it."""
        return parameters(self)

    def _uniform(self, like: Tensor, limits: list[float]) -> Tensor:
        """Return uniform random numbers in the shape of a tensor."""
        return torch.empty_like(like).uniform_(*limits)

    def _reset_state(self, mask: Tensor) -> None:
        """Draw positions and velocities for the worlds in ``mask``, and clear what they had."""
        self.sim.reset(mask)
        self.initial_state.draw(mask)
        self.sim.set_orientation(mask, self.init_angles)

    def _randomize_parameters(self, mask: Tensor) -> None:
        """Draw parameters of robot, ground and controller anew for the worlds in ``mask``."""
        self.randomization.draw(mask)
        self.sim.update_constants(mask)

    def _push_robots(self, mask: Tensor, add: Tensor) -> None:
        """Push the worlds in ``mask``: in those of ``add`` a drawn velocity is added, elsewhere set."""
        velocity = self._uniform(self.base_lin_vel, self.cfg.domain_rand.push_velocity)
        self.sim.push(mask, velocity, add)

    def _resample_commands(self, mask: Tensor) -> None:
        """Draw new commands for the worlds in ``mask``."""
        drawn = torch.addcmul(self._command_low, self._command_span, torch.rand_like(self.commands))
        torch.where(mask.unsqueeze(1), drawn, self.commands, out=self.commands)
