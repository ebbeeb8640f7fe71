"""Formulas of motor models, each once for torch and numpy; :mod:`legged_torque.motors.models` has them as kernels.

``xp`` is the module of the arrays. ``motor`` has, by name, the constants of the model, what it keeps from step to step,
and ``dt`` [s], ``decimation``, ``nominal_pose`` [rad], ``highest_torque`` [N m], ``p_gains`` [N m/rad] and ``d_gains``
[N m s/rad] of the robot. Arrays have the shape (num_dof,) or (num_envs, num_dof).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

SMALL = 1e-6  # in place of zero as a divisor


def ideal(xp: Any, motor: Any, wanted: Any, pos: Any, vel: Any) -> tuple[Any, dict[str, Any]]:
    """Limits of the robot, the same at any speed."""
    return xp.clip(wanted, motor.lowest_torque, motor.highest_torque), {}


def curve(xp: Any, motor: Any, wanted: Any, pos: Any, vel: Any) -> tuple[Any, dict[str, Any]]:
    """Torque-speed curve in Unitree's form.

    With the motion, at most Y1 (``driving_torque`` [N m]) up to the speed X1 (``knee_speed`` [rad/s]), then less in
    proportion, and none at X2 (``no_load_speed`` [rad/s]). Against it, Y2 (``braking_torque`` [N m]) at any speed, as
    in MuJoCo's ``dcmotor``. Unitree's trainer (unitree_rl_lab, unitree_actuators.py) lets it fall to 0 at X2 too, so
    that fast joints cannot brake.

    The bus voltage, as a share of the nominal one, multiplies X1 and X2. It is ``voltage``, less ``sag`` for each
    kilowatt of mechanical power in the control step before. This is an assumption, and so are its ranges: Unitree
    publishes neither torque constants nor resistances.
    """
    voltage = motor.voltage * (1.0 - motor.dip)
    knee, no_load, speed = motor.knee_speed * voltage, motor.no_load_speed * voltage, xp.abs(vel)
    share = xp.clip((no_load - speed) / xp.clip(no_load - knee, SMALL, None), 0.0, 1.0)
    most = xp.where(wanted * vel > 0.0, motor.driving_torque * share, motor.braking_torque)
    torque = xp.clip(wanted, -most, most)
    return torque, {"power": motor.power + torque * vel / motor.decimation}


def sag(xp: Any, motor: Any) -> dict[str, Any]:
    """Return the share of the voltage that :func:`curve` loses in a new control step; regenerated power is lost."""
    total = xp.sum(motor.power, axis=-1, keepdims=True)  # [W]
    return {"dip": xp.clip(motor.sag * total / 1000.0, 0.0, 1.0), "power": xp.zeros_like(motor.power)}


def drive(xp: Any, motor: Any, wanted: Any, pos: Any, vel: Any) -> tuple[Any, dict[str, Any]]:
    """A loop that the drive closes by itself at every physics step, without the delay of actions.

    ``wanted + stiffness (nominal_pose - pos) - damping vel``, in N m/rad and N m s/rad. Unitree's drives take torque,
    Kp, Kd and targets in one message and close this at 10 to 20 kHz.
    """
    return wanted + motor.stiffness * (motor.nominal_pose - pos) - motor.damping * vel, {}


def lag(xp: Any, motor: Any, wanted: Any, pos: Any, vel: Any) -> tuple[Any, dict[str, Any]]:
    """First-order lag with ``time_constant`` [s], exact for torques that stay the same during a physics step."""
    torque = motor.torque + _approach(xp, motor.dt, motor.time_constant) * (wanted - motor.torque)
    return torque, {"torque": torque}


def friction(xp: Any, motor: Any, wanted: Any, pos: Any, vel: Any) -> tuple[Any, dict[str, Any]]:
    """Static, Coulomb and viscous friction.

    ``wanted - lost``, where ``lost = dry tanh(vel / activation_speed) + viscous vel`` and ``dry = coulomb + load
    |wanted| + (static - coulomb) exp(-(vel / stribeck_speed)^2)``, in N m and N m s/rad. With static = coulomb it is
    that of unitree_rl_lab (Fs, Fd, Va). Stribeck and load are of BAM (github.com/Rhoban/bam), whose load is the torque
    on the gears, the motor's less the one from outside; only the motor's is known here. It is an explicit force: where
    static friction over ``activation_speed``, times the physics step, exceeds a joint's inertia, the joint trembles
    around rest.
    """
    stribeck = xp.exp(-((vel / motor.stribeck_speed) ** 2))
    dry = motor.coulomb_friction + motor.load_friction * xp.abs(wanted)
    dry = dry + (motor.static_friction - motor.coulomb_friction) * stribeck
    lost = dry * xp.tanh(vel / motor.activation_speed) + motor.viscous_friction * vel
    return wanted - lost, {"lost": lost}


def thermal(xp: Any, motor: Any, wanted: Any, pos: Any, vel: Any) -> tuple[Any, dict[str, Any]]:
    """Derating by the RMS torque, a measure of heat: ``mean_square`` follows torque^2 with ``time_constant`` [s].

    The limit is the robot's highest torque while the RMS is below ``derating_from`` times ``continuous_torque`` [N m],
    and falls linearly to the continuous torque, which it reaches when the RMS does. A continuous torque above the
    highest one limits nothing: another link must.
    """
    rms, continuous = xp.sqrt(motor.mean_square), motor.continuous_torque
    share = xp.clip((continuous - rms) / xp.clip(continuous * (1.0 - motor.derating_from), SMALL, None), 0.0, 1.0)
    most = continuous + share * xp.clip(motor.highest_torque - continuous, 0.0, None)
    torque = xp.clip(wanted, -most, most)
    share = _approach(xp, motor.dt, motor.time_constant)
    return torque, {"mean_square": motor.mean_square + share * (torque**2 - motor.mean_square)}


def quantize(xp: Any, motor: Any, wanted: Any, pos: Any, vel: Any) -> tuple[Any, dict[str, Any]]:
    """Torques as multiples of ``resolution`` [N m], halves to even ones: what a message to the drive can hold."""
    return motor.resolution * xp.round(wanted / motor.resolution), {}


def muscle(xp: Any, motor: Any, wanted: Any, pos: Any, vel: Any) -> tuple[Any, dict[str, Any]]:
    """A muscle that is activated and tires (SATA: Li et al., RSS 2025; marmotlab/SATA, go2_torque.py).

    Its limit is ``growth`` times the robot's highest torque. The activation follows ``tanh(wanted / limit)`` with
    ``activation_time`` [s], and the torque is ``activation limit (1 - sign(activation) vel / no_load_speed)``. The
    fatigue [N m s] is the sum of |torque| dt, of which each physics step leaves ``exp(-dt / recovery_time)``. The
    authors' figures are 0.6 of the way and 0.9 left per step of 5 ms.
    """
    limit = motor.growth * motor.highest_torque
    share = _approach(xp, motor.dt, motor.activation_time)
    activation = motor.activation + share * (xp.tanh(wanted / limit) - motor.activation)
    torque = activation * limit * (1.0 - xp.sign(activation) * vel / motor.no_load_speed)
    fatigue = (1.0 - _approach(xp, motor.dt, motor.recovery_time)) * (motor.fatigue + xp.abs(torque) * motor.dt)
    return torque, {"activation": activation, "fatigue": fatigue}


def encoder(xp: Any, motor: Any, pos: Any, vel: Any) -> tuple[Any, Any]:
    """Positions and velocities as multiples of ``position_resolution`` [rad] and ``velocity_resolution`` [rad/s].

    Policy, control law and the links before this one have them, and those behind it the true ones. The defaults are of
    the messages of Unitree's GO-M8010-6 (unitree_actuator_sdk): 2 pi / 32768 rad and 2 pi / 256 rad/s of a rotor whose
    gear is 6.33.
    """
    position, velocity = motor.position_resolution, motor.velocity_resolution
    return position * xp.round(pos / position), velocity * xp.round(vel / velocity)


def network(xp: Any, motor: Any, wanted: Any, pos: Any, vel: Any) -> tuple[Any, dict[str, Any]]:
    """A multilayer perceptron from logs of a position drive, the same for all joints (Hwangbo et al., 2019).

    Inputs as of IsaacLab's ``ActuatorNetMLP``: errors of the target, ``position_scale`` (target - pos), as many physics
    steps ago as ``history`` says, 0 before an episode; then ``velocity_scale`` vel likewise. The output times
    ``torque_scale`` is the torque [N m].

    What comes in are torques, so the target is the one at which PD control with the robot's gains asks for them: target
    - pos = (wanted + d_gains vel) / p_gains. For a position task this is the policy's target, whatever the gains are; a
    drawn strength of the motors multiplies what is asked for. A torque task needs the gains of the logged drive.
    """
    error = (wanted + motor.d_gains * vel) / motor.p_gains
    newest = xp.stack([motor.position_scale * error, motor.velocity_scale * vel], axis=-1)
    seen = xp.concatenate([newest[..., None], motor.seen[..., :-1]], axis=-1)
    values = xp.stack([seen[..., age] for age in motor.history], axis=-1).reshape(*wanted.shape, -1)
    activation = ACTIVATIONS[motor.activation]
    for number, layer in enumerate(motor.layers):
        values = (activation(xp, values) if number else values) @ layer[:, :-1].T + layer[:, -1]
    return motor.torque_scale * values[..., 0], {"seen": seen}


ACTIVATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "softsign": lambda xp, x: x / (1.0 + xp.abs(x)),
    "tanh": lambda xp, x: xp.tanh(x),
    "relu": lambda xp, x: xp.clip(x, 0.0, None),
    "elu": lambda xp, x: xp.where(x > 0.0, x, xp.expm1(xp.clip(x, None, 0.0))),
    "softplus": lambda xp, x: xp.clip(x, 0.0, None) + xp.log1p(xp.exp(-xp.abs(x))),
}
"""Activations of :func:`network` by name, between its layers."""


def _approach(xp: Any, dt: Any, time_constant: Any) -> Any:
    """Return the share of the way to a constant input that a first-order lag goes in ``dt`` [s]."""
    return 1.0 - xp.exp(-dt / xp.clip(time_constant, SMALL, None))


@dataclass(frozen=True)
class Formula:
    """A formula and what it keeps."""

    function: Callable[..., tuple[Any, Any]]  # (xp, motor, wanted, pos, vel) -> torques [N m], new state by name
    state: tuple[str, ...] = ()  # names of arrays, 0 at the start of an episode
    begin: Callable[..., dict[str, Any]] | None = None  # (xp, motor) -> new state, before a control step
    inner: Callable[[Any], tuple[int, ...]] = lambda motor: ()  # further axes of this state
    is_encoder: bool = False  # whether the function is (xp, motor, pos, vel) -> both as they are measured


FORMULAS = {
    "ideal": Formula(ideal),
    "curve": Formula(curve, ("power", "dip"), sag),
    "drive": Formula(drive),
    "lag": Formula(lag, ("torque",)),
    "friction": Formula(friction, ("lost",)),
    "thermal": Formula(thermal, ("mean_square",)),
    "quantize": Formula(quantize),
    "muscle": Formula(muscle, ("activation", "fatigue")),
    "encoder": Formula(encoder, is_encoder=True),
    "network": Formula(network, ("seen",), inner=lambda motor: (2, max(motor.history) + 1)),
}
"""The formulas by name, as ``policy.yaml`` has it under ``model``."""
