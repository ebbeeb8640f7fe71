"""Motor models in torch and as kernels; their formulas are in :mod:`legged_torque.motors.formulas`."""

from types import SimpleNamespace
from typing import Any, cast, get_args

import torch
import warp as wp
from torch import Tensor

from legged_torque.motors.formulas import FORMULAS, SMALL
from legged_torque.motors.kernel import read, struct_of
from legged_torque.motors.model_config import ModelCfg
from legged_torque.motors.motor import Joints, Motor
from legged_torque.sim.randomization import RandomParameter
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import Limits, types_of

_SMALL = wp.constant(SMALL)


@wp.func
def approach(dt: float, time_constant: float) -> float:
    """Return the share of the way to a constant input that a first-order lag goes in ``dt`` [s]."""
    return 1.0 - wp.exp(-dt / wp.max(time_constant, _SMALL))


@wp.struct
class Ideal:
    """Inputs of :func:`limited_torque`, (num_dof,)."""

    lowest_torque: wp.array[float]
    highest_torque: wp.array[float]


@wp.func
def limited_torque(m: Ideal, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float) -> float:
    """Return the torque of :func:`~legged_torque.motors.formulas.ideal`; NaN stays NaN, as in torch."""
    low, high = m.lowest_torque[joint], m.highest_torque[joint]
    return wp.where(wanted < low, low, wp.where(wanted > high, high, wanted))


@wp.struct
class Curve:
    """Inputs of :func:`curve_torque`, all of them (num_envs, num_dof)."""

    knee_speed: wp.array2d[float]
    no_load_speed: wp.array2d[float]
    driving_torque: wp.array2d[float]
    braking_torque: wp.array2d[float]
    voltage: wp.array2d[float]
    dip: wp.array2d[float]
    power: wp.array2d[float]
    decimation: int


@wp.func
def curve_torque(m: Curve, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float) -> float:
    """Return the torque of :func:`~legged_torque.motors.formulas.curve`."""
    voltage = m.voltage[world, joint] * (1.0 - m.dip[world, joint])
    knee, no_load = m.knee_speed[world, joint] * voltage, m.no_load_speed[world, joint] * voltage
    share = wp.clamp((no_load - wp.abs(vel)) / wp.max(no_load - knee, _SMALL), 0.0, 1.0)
    most = wp.where(wanted * vel > 0.0, m.driving_torque[world, joint] * share, m.braking_torque[world, joint])
    torque = wp.where(wanted < -most, -most, wp.where(wanted > most, most, wanted))  # NaN stays NaN
    m.power[world, joint] = m.power[world, joint] + torque * vel / float(m.decimation)
    return torque


@wp.struct
class Drive:
    """Inputs of :func:`drive_torque`, (num_envs, num_dof) but for the pose (num_dof,)."""

    stiffness: wp.array2d[float]
    damping: wp.array2d[float]
    nominal_pose: wp.array[float]


@wp.func
def drive_torque(m: Drive, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float) -> float:
    """Return the torque of :func:`~legged_torque.motors.formulas.drive`."""
    return wanted + m.stiffness[world, joint] * (m.nominal_pose[joint] - pos) - m.damping[world, joint] * vel


@wp.struct
class Lag:
    """Inputs of :func:`lagging_torque`, (num_envs, num_dof)."""

    time_constant: wp.array2d[float]
    torque: wp.array2d[float]
    dt: float


@wp.func
def lagging_torque(m: Lag, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float) -> float:
    """Return the torque of :func:`~legged_torque.motors.formulas.lag`."""
    before = m.torque[world, joint]
    torque = before + approach(m.dt, m.time_constant[world, joint]) * (wanted - before)
    m.torque[world, joint] = torque
    return torque


@wp.struct
class Friction:
    """Inputs of :func:`friction_torque`, (num_envs, num_dof)."""

    static_friction: wp.array2d[float]
    coulomb_friction: wp.array2d[float]
    viscous_friction: wp.array2d[float]
    load_friction: wp.array2d[float]
    stribeck_speed: wp.array2d[float]
    activation_speed: wp.array2d[float]
    lost: wp.array2d[float]


@wp.func
def friction_torque(m: Friction, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float) -> float:
    """Return the torque of :func:`~legged_torque.motors.formulas.friction`."""
    relative, coulomb = vel / m.stribeck_speed[world, joint], m.coulomb_friction[world, joint]
    dry = coulomb + m.load_friction[world, joint] * wp.abs(wanted)
    dry += (m.static_friction[world, joint] - coulomb) * wp.exp(-relative * relative)
    lost = dry * wp.tanh(vel / m.activation_speed[world, joint]) + m.viscous_friction[world, joint] * vel
    m.lost[world, joint] = lost
    return wanted - lost


@wp.struct
class Thermal:
    """Inputs of :func:`derated_torque`, (num_envs, num_dof) but for the highest torque (num_dof,)."""

    continuous_torque: wp.array2d[float]
    time_constant: wp.array2d[float]
    derating_from: wp.array2d[float]
    mean_square: wp.array2d[float]
    highest_torque: wp.array[float]
    dt: float


@wp.func
def derated_torque(m: Thermal, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float) -> float:
    """Return the torque of :func:`~legged_torque.motors.formulas.thermal`."""
    heat, continuous = m.mean_square[world, joint], m.continuous_torque[world, joint]
    span = wp.max(continuous * (1.0 - m.derating_from[world, joint]), _SMALL)
    share = wp.clamp((continuous - wp.sqrt(heat)) / span, 0.0, 1.0)
    most = continuous + share * wp.max(m.highest_torque[joint] - continuous, 0.0)
    torque = wp.where(wanted < -most, -most, wp.where(wanted > most, most, wanted))
    m.mean_square[world, joint] = heat + approach(m.dt, m.time_constant[world, joint]) * (torque * torque - heat)
    return torque


@wp.struct
class Quantize:
    """Inputs of :func:`quantized_torque`, (num_envs, num_dof)."""

    resolution: wp.array2d[float]


@wp.func
def quantized_torque(m: Quantize, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float) -> float:
    """Return the torque of :func:`~legged_torque.motors.formulas.quantize`."""
    return m.resolution[world, joint] * wp.rint(wanted / m.resolution[world, joint])


@wp.struct
class Muscle:
    """Inputs of :func:`muscle_torque`, (num_envs, num_dof) but for the highest torque (num_dof,)."""

    activation_time: wp.array2d[float]
    recovery_time: wp.array2d[float]
    no_load_speed: wp.array2d[float]
    growth: wp.array2d[float]
    activation: wp.array2d[float]
    fatigue: wp.array2d[float]
    highest_torque: wp.array[float]
    dt: float


@wp.func
def muscle_torque(m: Muscle, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float) -> float:
    """Return the torque of :func:`~legged_torque.motors.formulas.muscle`."""
    limit, before = m.growth[world, joint] * m.highest_torque[joint], m.activation[world, joint]
    activation = before + approach(m.dt, m.activation_time[world, joint]) * (wp.tanh(wanted / limit) - before)
    torque = activation * limit * (1.0 - wp.sign(activation) * vel / m.no_load_speed[world, joint])
    m.activation[world, joint] = activation
    left = 1.0 - approach(m.dt, m.recovery_time[world, joint])
    m.fatigue[world, joint] = left * (m.fatigue[world, joint] + wp.abs(torque) * m.dt)
    return torque


@wp.struct
class Encoder:
    """Inputs of :func:`measured_state`, (num_envs, num_dof)."""

    position_resolution: wp.array2d[float]
    velocity_resolution: wp.array2d[float]


@wp.func
def measured_state(m: Encoder, world: int, joint: int, pos: float, vel: float) -> wp.vec2:
    """Return position and velocity of :func:`~legged_torque.motors.formulas.encoder`."""
    position, velocity = m.position_resolution[world, joint], m.velocity_resolution[world, joint]
    return wp.vec2(position * wp.rint(pos / position), velocity * wp.rint(vel / velocity))


KERNELS = {
    "ideal": limited_torque,
    "curve": curve_torque,
    "drive": drive_torque,
    "lag": lagging_torque,
    "friction": friction_torque,
    "thermal": derated_torque,
    "quantize": quantized_torque,
    "muscle": muscle_torque,
    "encoder": measured_state,
}
"""The Warp functions of formulas, by name; a network has none, since one thread would compute all of it."""


class ModelMotor(Motor):
    """A link that computes a formula, in torch and in the kernel.

    A user's subclass may change the formula: it runs in torch, unless it names its :attr:`kernel`, and exports know it
    by a ``describe`` of its own.

    Attributes:
        values: Constants, state and numbers of the robot by name, see :mod:`legged_torque.motors.formulas`.
    """

    cfg: ModelCfg

    def __init__(self, cfg: ModelCfg, joints: Joints) -> None:
        """Lay out the constants, with a row per world for those that are drawn. Errors as of ``cfg.constants``."""
        super().__init__(cfg, joints)
        self.formula = FORMULAS[cfg._model]
        if self._is_ours():
            self.kernel = KERNELS.get(cfg._model)  # type: ignore[misc]
        self.values = SimpleNamespace(dt=joints.dt, decimation=joints.decimation, nominal_pose=joints.nominal_pose)
        self.values.lowest_torque, self.values.highest_torque = joints.torque_limits
        self.values.p_gains, self.values.d_gains = joints.gains
        for name, numbers in cfg.constants(joints.names, joints.section).items():
            rows = torch.tensor(numbers, device=self.device).expand(self.num_envs, -1)
            setattr(self.values, name, rows.clone() if name in cfg.draws else rows)
        vars(self.values).update(cfg.whole(lambda numbers: torch.tensor(numbers, device=self.device), joints.dt))
        for name in self.formula.state:
            setattr(self.values, name, self.buffer(name, len(joints.names), *self.formula.inner(self.values)))
        self.lost = self._buffers.get("lost")

    def finish_step(self) -> None:
        """Prepare the next control step."""
        if self.formula.begin:
            self._keep(self.formula.begin(torch, self.values))

    def apply(self, wanted: Tensor, pos: Tensor, vel: Tensor, substep: int) -> Tensor:
        """Return the torques of the formula."""
        torques, state = self.formula.function(torch, self.values, wanted, pos, vel)
        self._keep(state)
        return torques

    def _keep(self, state: dict[str, Tensor]) -> None:
        """Write new state in place."""
        for name, values in state.items():
            self._buffers[name].copy_(values)

    def _is_ours(self) -> bool:
        """Return whether the class is one of this module, not a user's."""
        return type(self).__module__ == __name__

    def describe(self) -> dict[str, Any]:
        """Return the constants of the link, which do not describe a user's subclass."""
        return super().describe() if self._is_ours() else {}

    def kernel_reads(self) -> Any:
        """Return those of :attr:`values` that the kernel reads."""
        struct = struct_of(self.kernel)
        return read(struct, **{name: getattr(self.values, name) for name in struct.vars})

    def reset(self, mask: Tensor) -> None:
        """Forget the state of ended episodes."""
        for values in self._buffers.values():
            values.masked_fill_(mask.view(-1, *[1] * (values.dim() - 1)), 0.0)

    def random_parameters(self) -> list[RandomParameter]:
        """Return what ``draws`` names, each as one number per world."""
        link, columns = self.joints.section.removeprefix("motors."), range(len(self.joints.names))
        types, draws = types_of(cast(type, type(self.cfg))), cast(dict[str, Any], self.cfg.draws)
        drawn = []
        for name, draw in draws.items():
            bounds = next((part for part in get_args(types.get(name)) if isinstance(part, Limits)), Limits())
            values = getattr(self.values, name)
            drawn.append(RandomParameter(f"{link}_{name}", values, columns, draw, shared=True, bounds=bounds))
        return drawn


class NetworkModel(ModelMotor):
    """A network from logged data."""

    def __init__(self, cfg: ModelCfg, joints: Joints) -> None:
        """Read the network; a UserError if it is of another form, or there is no target that gives its errors."""
        if not bool((joints.gains[0] > 0.0).all()):
            needed = "a control.stiffness above 0 of all joints"
            raise UserError(f"{joints.section} needs {needed}, to have errors of targets")
        super().__init__(cfg, joints)


class MuscleModel(ModelMotor):
    """A link whose torque limits grow in training."""

    def __init__(self, cfg: ModelCfg, joints: Joints) -> None:
        """Give the growth memory of its own. Errors as of ``cfg.constants``."""
        super().__init__(cfg, joints)
        self.values.growth = self.values.growth.clone()

    def describe(self) -> dict[str, Any]:
        """Return model and constants, and the growth of this moment of training."""
        growth = self.values.growth[0].tolist()
        return super().describe() | {"growth": dict(zip(self.joints.names, growth, strict=True))}


class EncoderModel(ModelMotor):
    """A link that changes what is measured of joints."""

    acts_on = "measurements"

    def measured(self, pos: Tensor, vel: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions [rad] and velocities [rad/s] as they are measured. Shapes: (num_envs, num_dof)."""
        return self.formula.function(torch, self.values, pos, vel)
