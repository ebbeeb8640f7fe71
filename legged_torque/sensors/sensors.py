"""The sensors of a task by name."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from legged_torque.envs.base.state import RobotState
from legged_torque.sensors.config import SensorCfg
from legged_torque.sensors.height_scan import HeightScan
from legged_torque.sensors.sensor import Sensor


class Sensors(dict[str, Sensor]):
    """The sections of ``sensors``, built, and on rough ground the height scan, "height_scan".

    Attributes:
        height_scan: The height scan; None on a plane.
        has_kernels: Whether some of them launch kernels of Warp, which cannot be compiled with torch's operations.
    """

    def __init__(self, settings: Any, terrain: Any, state: RobotState, add_noise: bool) -> None:
        """Build the sensors of the sections ``sensors`` and ``terrain`` of settings."""
        sections = {name: value for name, value in vars(settings).items() if isinstance(value, SensorCfg)}
        super().__init__({name: section.build(state) for name, section in sections.items()})
        self.height_scan = HeightScan(terrain, state) if state.ground.map is not None else None
        if self.height_scan:
            self["height_scan"] = self.height_scan
        for sensor in self.values():
            sensor.has_noise = add_noise
        self.has_kernels = not all(sensor.compilable for sensor in self.values())

    def update_all(self, is_new: Tensor, compilable: bool) -> None:
        """Let those sensors measure that are ``compilable``, or those that are not; see :meth:`Sensor.update`."""
        for sensor in self.values():
            if sensor.compilable == compilable:
                sensor.update(is_new)

    @contextlib.contextmanager
    def looking_ahead(self) -> Iterator[None]:
        """Measure for what is done inside, and forget it afterwards."""
        kept = {name: {key: value.clone() for key, value in s.state_dict().items()} for name, s in self.items()}
        for sensor in self.values():
            sensor.update(torch.zeros_like(sensor.state.reset_buf))
        yield
        for name, sensor in self.items():
            for key, value in sensor.state_dict().items():
                value.copy_(kept[name][key])

    def state_dict(self) -> dict[str, Any]:
        """Return what the sensors keep, by name."""
        return {name: sensor.state_dict() for name, sensor in self.items()}
