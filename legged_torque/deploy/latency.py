"""Packets that come late to one robot, in numpy, as :mod:`legged_torque.sim.packets` has them for many."""

from typing import Any

import numpy as np

from legged_torque.motors.config import LatencyCfg


class Latency:
    """Packets between a policy and a robot; time counts in physics steps."""

    def __init__(self, description: dict[str, Any], name: str) -> None:
        """Take an entry of ``latency`` of ``policy.yaml``; without it, packets arrive at once.

        A UserError if its times make no sense.
        """
        cfg, settings, timing = LatencyCfg(), description.get("latency", {}).get(name), description["timing"]
        vars(cfg).update(settings or {})
        cfg.check(f"latency.{name}")
        self.is_needed = settings is not None
        clock = (1.0 / timing["physics_frequency"], timing["decimation"])
        self._times, self._jitter, self._unit_steps = cfg.counted(f"latency.{name}", *clock)
        self._loss = cfg.loss

    def restart(self, rng: np.random.Generator, packet: Any) -> None:
        """Draw a constant time for a new episode, in which the receiver has a packet from the start on."""
        self._rng, self._queue = rng, [(0, packet)]  # arrival and packet; what the receiver has is the first
        self._constant = int(rng.integers(self._times[0], self._times[1] + 1)) if self.is_needed else 0

    def send(self, now: int, packet: Any) -> None:
        """Send a packet, which may get lost."""
        extra = int(self._rng.integers(0, self._jitter + 1)) if self.is_needed else 0
        if not (self.is_needed and self._rng.random() < self._loss):
            self._queue.append((now + (self._constant + extra) * self._unit_steps, packet))

    def received(self, now: int) -> Any:
        """Return the newest packet that has arrived."""
        newest = max(i for i, (arrival, _) in enumerate(self._queue) if arrival <= now)
        self._queue = self._queue[newest:]
        return self._queue[0][1]
