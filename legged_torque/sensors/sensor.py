"""The interface of sensors."""

import torch
from torch import Tensor

from legged_torque.envs.base.state import RobotState
from legged_torque.sensors.config import SensorCfg
from legged_torque.utils.buffers import Buffers, check_tensor
from legged_torque.utils.errors import UserError


class Sensor(Buffers):
    """Measures numbers, vectors or images of all worlds.

    A sensor is a subclass with :meth:`shape` and :meth:`measure`, and a section of ``sensors`` whose ``build`` makes
    it. Observation terms read :attr:`values` of ``LeggedRobot.sensors[name]``. Measurements are kept, held and delayed
    here, inside a CUDA graph, and are part of checkpoints.

    Attributes:
        newest: The last measurement, with errors. Shape: (num_envs, *shape()).
        values: The same, late. Shape: (num_envs, *shape()).
    """

    compilable = True
    """Whether :meth:`measure` has torch's operations only. One that launches kernels of Warp says False."""

    def __init__(self, cfg: SensorCfg, state: RobotState) -> None:
        """Allocate what is kept. A UserError for a rate or delay that control steps cannot have."""
        super().__init__(state.num_envs, state.device)
        self.cfg, self.state = cfg, state
        steps = 1.0 / (cfg.rate * state.dt) if cfg.rate else 1.0
        self.interval = round(steps)  # control steps from one measurement to the next
        if abs(steps - self.interval) > 1e-6 * steps:
            of_steps = f"that of the control steps, {1 / state.dt:g} Hz"
            raise UserError(f"a sensor's rate must divide {of_steps}, not {cfg.rate:g}")
        late = cfg.delay / state.dt
        self.delay = round(late)  # control steps
        if abs(late - self.delay) > 1e-6 * late:
            raise UserError(f"a sensor's delay must be whole control steps of {state.dt:g} s, not {cfg.delay:g} s")
        if not isinstance(self.shape(), tuple):
            raise UserError(f"{type(self).__name__}.shape must return a tuple, such as (3,), not {self.shape()}")
        self.has_noise = False  # whether errors are added; the task sets it
        self._kept = self.buffer("kept", self.delay + 1, *self.shape())  # the newest first
        self.newest, self.values = self._kept[:, 0], self._kept[:, -1]

    def shape(self) -> tuple[int, ...]:
        """Return the shape of a world's measurement."""
        raise UserError(f"{type(self).__name__} has no shape")

    def measure(self) -> Tensor:
        """Return a measurement of this moment, without delay and errors. Shape: (num_envs, *shape())."""
        raise UserError(f"{type(self).__name__} has no measure")

    def update(self, is_new: Tensor) -> None:
        """Measure, where and when it is time, once per control step.

        Where an episode has just started, as ``is_new`` says, nothing from before is left. A UserError if the
        measurement has another shape. Shape: (num_envs,), bool.
        """
        now, new = self.measure(), is_new.view(-1, *[1] * len(self.shape()))
        check_tensor(f"what {type(self).__name__}.measure returns", now, self.newest.shape, self.device)
        if self.has_noise and self.cfg.noise:
            now = now + self.cfg.noise * (2.0 * torch.rand_like(now) - 1.0)
        if self.interval > 1:
            is_due = (self.state.episode_length % self.interval == 0).view(new.shape)
            now = torch.where(is_due | new, now, self.newest)
        now, new = now.unsqueeze(1), new.unsqueeze(1)
        self._kept.copy_(torch.cat([now, torch.where(new, now, self._kept[:, :-1])], dim=1) if self.delay else now)
