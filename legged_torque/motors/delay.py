"""Time that actions take from the policy to the motors."""

from __future__ import annotations

import math
from typing import Any

import torch
import warp as wp
from torch import Tensor

from legged_torque.motors.config import DelayCfg
from legged_torque.motors.joints import Joints
from legged_torque.motors.kernel import read
from legged_torque.motors.motor import Motor
from legged_torque.sim.randomization import RandomParameter


@wp.struct
class Delay:
    """Inputs of :func:`delayed_actions`, see :class:`ActionDelay`."""

    newest: wp.array2d[float]
    before: wp.array3d[float]
    drawn: wp.array2d[float]
    unit_steps: int
    decimation: int
    depth: int


@wp.func
def delayed_actions(delay: Delay, world: int, substep: int) -> wp.array[float]:
    """Return the actions of a world that have reached its motors by a physics step."""
    missing = int(wp.clamp(delay.drawn[world, 0], 0.0, 1.0e4)) * delay.unit_steps - substep
    age = wp.clamp((missing + delay.decimation - 1) // delay.decimation, 0, delay.depth)  # control steps ago
    return wp.where(age > 0, delay.before[world, wp.max(age, 1) - 1], delay.newest[world])


class ActionDelay(Motor):
    """Holds actions back, in each world for a time that is drawn at every reset.

    Attributes:
        newest: The newest actions. Shape: (num_envs, num_actions).
        before: Older ones, the newest first. Shape: (num_envs, control steps, num_actions).
        drawn: The delay in ``motors.delay.unit``; its whole part counts. Shape: (num_envs, 1).
    """

    acts_on = "actions"
    kernel = delayed_actions
    cfg: DelayCfg

    def __init__(self, cfg: DelayCfg, joints: Joints) -> None:
        """Allocate room for the longest delay; there is none until one is drawn."""
        super().__init__(cfg, joints)
        self.unit_steps = joints.decimation if cfg.unit == "control_steps" else 1  # physics steps of the unit
        self.depth = math.ceil(cfg.range[1] * self.unit_steps / joints.decimation)  # older actions that are kept
        num_actions = joints.actions.shape[1]
        self.newest = self.buffer("newest", num_actions) if self.depth else joints.actions
        self.before, self.drawn = self.buffer("before", self.depth, num_actions), self.buffer("drawn", 1)

    def send(self, actions: Tensor) -> None:
        """Keep the actions of this control step and of those before."""
        if self.depth:
            self.before.copy_(torch.cat([self.newest.unsqueeze(1), self.before[:, :-1]], dim=1))
            self.newest.copy_(actions)

    def apply(self, wanted: Tensor, pos: Tensor, vel: Tensor, substep: int) -> Tensor:
        """Return the actions that have reached the motors. Shape: (num_envs, num_actions)."""
        if not self.depth:
            return self.newest
        missing = self.drawn.floor() * self.unit_steps - substep
        age = (missing / self.joints.decimation).ceil().long().clamp(0, self.depth)  # NaN becomes any number
        history = torch.cat([self.newest.unsqueeze(1), self.before], dim=1)
        return history.gather(1, age.unsqueeze(2).expand(-1, 1, history.shape[2])).squeeze(1)

    def kernel_reads(self) -> Any:
        """Return the actions and the delays."""
        arrays = {"newest": self.newest, "before": self.before, "drawn": self.drawn}
        counts = {"unit_steps": self.unit_steps, "decimation": self.joints.decimation, "depth": self.depth}
        return read(Delay, **arrays, **counts)

    def reset(self, mask: Tensor) -> None:
        """Forget the actions of ended episodes."""
        if self.depth:
            self.newest.masked_fill_(mask.unsqueeze(1), 0.0)
            self.before.masked_fill_(mask.view(-1, 1, 1), 0.0)

    def random_parameters(self) -> list[RandomParameter]:
        """Return the delay, any whole number of the range being as likely."""
        shortest, longest = self.cfg.range
        drawn = {"set": [float(shortest), longest + 1.0]}
        limits = ([float(shortest)], [longest + 0.5])
        return [RandomParameter("action_delay", self.drawn, [0], drawn, limits=limits, at_reset_only=True)]

    def describe(self) -> dict[str, Any]:
        """Return the range and its unit."""
        return {"range": list(self.cfg.range), "unit": self.cfg.unit} if self.depth else {}
