"""The sensors of a task by name."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from legged_torque.envs.base.state import RobotState
from legged_torque.motors.chain import MotorChain
from legged_torque.sensors.config import SensorCfg
from legged_torque.sensors.height_scan import HeightScan
from legged_torque.sensors.sensing import Sensing
from legged_torque.sensors.sensor import Sensor
from legged_torque.sim.randomization import RandomParameter
from legged_torque.utils.errors import UserError, unknown_name


class Sensors(dict[str, Sensor]):
    """The sections of ``sensors``, built, and on rough ground the height scan, "height_scan".

    Attributes:
        height_scan: The height scan; None on a plane.
        sensing: Joint encoders and IMU; None if what they measure is exact and not late.
        has_kernels: Whether some of them launch kernels of Warp, which cannot be compiled with torch's operations.
    """

    def __init__(self, cfg: Any, state: RobotState, motors: MotorChain) -> None:
        """Build the sensors of the sections ``sensors``, ``terrain`` and ``sensing`` of a task's settings.

        ``motors`` have the joint encoders.
        """
        sections = vars(cfg.sensors)
        if others := [f"sensors.{name}" for name, value in sections.items() if not isinstance(value, SensorCfg)]:
            raise UserError(f"{', '.join(others)} must inherit SensorCfg, as all sections of sensors")
        super().__init__({name: section.build(state) for name, section in sections.items()})
        if others := [f"sensors.{name}.build" for name, sensor in self.items() if not isinstance(sensor, Sensor)]:
            raise UserError(f"{', '.join(others)} must return a Sensor")
        self.height_scan = HeightScan(cfg.terrain, state) if state.ground.map is not None else None
        if self.height_scan:
            if "height_scan" in self:
                raise UserError("sensors.height_scan has the name of the height scan of rough ground: give it another")
            self["height_scan"] = self.height_scan
        for sensor in self.values():
            sensor.has_noise = cfg.noise.add_noise
            sensor.hold_tensors()
        sensing = Sensing(cfg.sensing.delay, state, motors, cfg.sim.dt, cfg.control.decimation)
        self.sensing = sensing if sensing.queue.is_needed or motors.encoder else None
        self._is_late = bool(self.sensing) and sensing.queue.is_needed
        self.has_kernels = not all(sensor.compilable for sensor in self.values())

    def __missing__(self, name: str) -> Sensor:
        """Raise a UserError: there is no such sensor."""
        raise unknown_name("sensor", name, self)

    def begin_step(self) -> list[Callable[[], None]]:
        """Begin a control step; return what to call after each physics step, if sensors measure then."""
        if not self.sensing or not self._is_late:
            return []
        self.sensing.begin_step()
        return [self.sensing.measure]

    def begin_episodes(self, is_new: Tensor) -> None:
        """Forget what was measured before the episodes that have just started. Shape: (num_envs,), bool."""
        if self.sensing:
            self.sensing.begin_episodes(is_new)

    def update_all(self, is_new: Tensor, compilable: bool) -> None:
        """Let those sensors measure that are ``compilable``, or those that are not; see :meth:`Sensor.update`."""
        for sensor in self.values():
            if sensor.compilable == compilable:
                sensor.update(is_new)
        if self.sensing and compilable:
            self.sensing.look()

    @contextlib.contextmanager
    def looking_ahead(self) -> Iterator[None]:
        """Measure for what is done inside, and forget it afterwards."""
        kept = {name: {key: value.clone() for key, value in s.state_dict().items()} for name, s in self.items()}
        for sensor in self.values():
            sensor.update(torch.zeros_like(sensor.state.reset_buf))
        if self.sensing:
            self.sensing.look()
        yield
        for name, sensor in self.items():
            for key, value in sensor.state_dict().items():
                value.copy_(kept[name][key])

    def state_dict(self) -> dict[str, Any]:
        """Return what the sensors keep, by name."""
        late = {"sensing.queue": self.sensing.queue.state_dict()} if self.sensing else {}
        return {name: sensor.state_dict() for name, sensor in self.items()} | late

    def watched(self) -> dict[str, Tensor]:
        """Return the tensors that must be finite in every world. Shapes: (num_envs, any)."""
        kept = self.sensing.queue.state_dict() if self.sensing else {}
        return {f"sensing.{name}": value.flatten(1) for name, value in kept.items()}

    def random_parameters(self) -> list[RandomParameter]:
        """Return what is drawn of the sensors."""
        return [self.sensing.queue.random_parameter("sensing_delay")] if self.sensing else []
