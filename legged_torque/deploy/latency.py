"""Packets that come late to one robot, in numpy, as :mod:`legged_torque.sim.packets` has them for many."""

from __future__ import annotations

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
        self._rng, self._held, self._sent = rng, packet, 0
        self._on_the_way: list[tuple[int, int, Any]] = []  # arrival, number, packet
        self._constant = int(rng.integers(self._times[0], self._times[1] + 1)) if self.is_needed else 0

    def send(self, now: int, packet: Any) -> None:
        """Send a packet, which may get lost."""
        self._sent += 1
        extra, is_lost = 0, False
        if self.is_needed:
            extra, is_lost = int(self._rng.integers(0, self._jitter + 1)), self._rng.random() < self._loss
        if not is_lost:
            arrival = now + (self._constant + extra) * self._unit_steps
            self._on_the_way.append((arrival, self._sent, packet))

    def received(self, now: int) -> Any:
        """Return the newest packet that has arrived."""
        arrived = [(number, packet) for arrival, number, packet in self._on_the_way if arrival <= now]
        if arrived:
            newest, self._held = max(arrived, key=lambda entry: entry[0])
            self._on_the_way = [entry for entry in self._on_the_way if entry[1] > newest]
        return self._held
