"""Settings of sensors: one section of ``sensors`` per sensor. They need no torch."""

from typing import Annotated, Any

from legged_torque.utils.config import Section
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import Limits, NotNegative


class SensorCfg(Section):
    """Settings of a sensor. Inherit for one of your own, and override :meth:`build`."""

    rate: NotNegative = 0.0  # [Hz] of new measurements; 0: at every control step
    delay: Annotated[float, Limits(0, 10)] = 0.0  # [s] by which measurements are late, whole control steps
    noise: NotNegative = 0.0  # largest error, uniform, where ``noise.add_noise`` is on

    def build(self, state: Any) -> Any:
        """Return the :class:`~legged_torque.sensors.sensor.Sensor` for a robot's state."""
        raise UserError(f"{type(self).__name__} has no build")
