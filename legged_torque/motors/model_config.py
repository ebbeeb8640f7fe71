"""Settings of motor models: constants by joint, which may be drawn at random in each world. They need no torch."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

from legged_torque import resource_path
from legged_torque.motors.config import DelayCfg, MotorCfg, PerturbationCfg, by_joint
from legged_torque.utils.config import Section, section_keys, to_dict, update_from_dict
from legged_torque.utils.errors import UserError, check_names
from legged_torque.utils.files import read_data
from legged_torque.utils.limits import DrawLimits, Interval, Limits, Positive

PerJoint = Annotated[float | dict[str, float], Limits(lowest=0)]
PositivePerJoint = Annotated[float | dict[str, float], Limits(above=0)]
SharePerJoint = Annotated[float | dict[str, float], Limits(0, 1)]
Draws = dict[str, Annotated[dict[Literal["set", "add", "scale"], Interval], DrawLimits()]]
ASSUMED_VOLTAGE: Draws = {"voltage": {"set": [0.85, 1.05]}}
"""Shares of the nominal voltage that batteries are assumed to have; no source gives those of these robots."""

MOST_WEIGHTS = 20_000  # of a network: settings of a run are read up to a million characters


class ModelCfg(MotorCfg):
    """Settings of a :class:`~legged_torque.motors.models.ModelMotor`; its constants are by joint."""

    _motor_class = "legged_torque.motors.models:ModelMotor"
    _model = ""  # name of its formula, see ``motors.formulas``
    _others: tuple[str, ...] = ("draws",)  # settings that are no constants of the formula
    draws: Draws = {}  # of constants by name, each one number per world: ranges as in ``domain_rand``

    def constants(self, dof_names: Sequence[str], path: str) -> dict[str, list[float]]:
        """Return the numbers of all joints by constant; a UserError names what joints or ``draws`` do not have."""
        names = [name for name in section_keys(self) if name not in self._others]
        check_names(f"{path}.draws", self.draws, names)
        return {name: by_joint(f"{path}.{name}", getattr(self, name), dof_names) for name in names}

    def whole(self, array: Callable[[Any], Any], dt: float) -> dict[str, Any]:
        """Return what the formula reads besides constants of joints, after :meth:`constants`.

        Args:
            array: Makes an array of nested lists of numbers.
            dt: Physics step [s].
        """
        return {}

    def describe(self) -> dict[str, Any]:
        """Return model and constants for ``policy.yaml``."""
        settings = {name: value for name, value in to_dict(self).items() if name not in self._others}
        return {"model": self._model} | settings


class IdealCfg(ModelCfg):
    """Settings of :func:`~legged_torque.motors.formulas.ideal`: any torque within the limits, at once."""

    _model = "ideal"


class CurveCfg(ModelCfg):
    """Settings of :func:`~legged_torque.motors.formulas.curve`: how much torque at which speed; as they are, any."""

    _model, _others = "curve", ("draws", "armature")
    knee_speed: PerJoint = 1e9  # [rad/s] X1, up to which a motor has its whole torque
    no_load_speed: PerJoint = 1e9  # [rad/s] X2, at which it has none
    driving_torque: PerJoint = 1e9  # [N m] Y1, most with the motion
    braking_torque: PerJoint = 1e9  # [N m] Y2, most against it
    voltage: PerJoint = 1.0  # of the bus, as a share of the nominal one
    sag: PerJoint = 0.0  # [1/kW] share of the voltage lost per mechanical power of all joints
    armature: PerJoint | None = None  # [kg m^2] of the rotors through their gears; None: that of the robot's file

    def constants(self, dof_names: Sequence[str], path: str) -> dict[str, list[float]]:
        """Return the numbers of all joints; a UserError if one has its knee beyond the no-load speed."""
        values = super().constants(dof_names, path)
        for joint, knee, no_load in zip(dof_names, values["knee_speed"], values["no_load_speed"], strict=True):
            if knee > no_load:
                speeds = f"{path}.no_load_speed, {no_load:g}, of the joint '{joint}'"
                raise UserError(f"{path}.knee_speed must be at most {speeds}, not {knee:g}")
        return values


class DriveCfg(ModelCfg):
    """Settings of :func:`~legged_torque.motors.formulas.drive`: gains that the drive itself closes."""

    _model, _of_law = "drive", True
    damping: PerJoint = 0.0  # [N m s/rad] Kd
    stiffness: PerJoint = 0.0  # [N m/rad] Kp, towards the nominal pose


class LagCfg(ModelCfg):
    """Settings of :func:`~legged_torque.motors.formulas.lag`: torques rise in a while."""

    _model = "lag"
    time_constant: PerJoint = 0.0  # [s]


class FrictionCfg(ModelCfg):
    """Settings of :func:`~legged_torque.motors.formulas.friction`, in addition to that of the robot's file."""

    _model = "friction"
    static_friction: PerJoint = 0.0  # [N m] at rest
    coulomb_friction: PerJoint = 0.0  # [N m] in motion
    viscous_friction: PerJoint = 0.0  # [N m s/rad]
    load_friction: PerJoint = 0.0  # share of the motor's torque
    stribeck_speed: PositivePerJoint = 0.1  # [rad/s] from static to Coulomb friction
    activation_speed: PositivePerJoint = 0.01  # [rad/s] at which friction acts against the motion


class ThermalCfg(ModelCfg):
    """Settings of :func:`~legged_torque.motors.formulas.thermal`: less torque for motors that were loaded for long."""

    _model = "thermal"
    continuous_torque: PositivePerJoint = 1e9  # [N m] RMS that a motor bears for any time
    time_constant: PositivePerJoint = 60.0  # [s]
    derating_from: SharePerJoint = 0.8  # share of the continuous torque


class QuantizeCfg(ModelCfg):
    """Settings of :func:`~legged_torque.motors.formulas.quantize`: steps of torques."""

    _model = "quantize"
    resolution: PositivePerJoint = 0.01  # [N m]


class MuscleCfg(ModelCfg):
    """Settings of :func:`~legged_torque.motors.formulas.muscle`, see :mod:`legged_torque.envs.approaches.sata`."""

    _motor_class = "legged_torque.motors.models:MuscleModel"
    _model, _of_law = "muscle", True
    activation_time: PositivePerJoint = -0.005 / math.log(0.4)  # [s] time constant of the activation
    recovery_time: PositivePerJoint = -0.005 / math.log(0.9)  # [s] of the fatigue
    no_load_speed: PositivePerJoint = 21.0  # [rad/s] at which a joint has no torque; of the A1
    growth: PositivePerJoint = 1.0  # share of the torque limits, which changes in training


class EncoderCfg(ModelCfg):
    """Settings of :func:`~legged_torque.motors.formulas.encoder`: steps of what joint encoders measure."""

    _motor_class = "legged_torque.motors.models:EncoderModel"
    _model = "encoder"
    position_resolution: PositivePerJoint = 3.03e-5  # [rad]
    velocity_resolution: PositivePerJoint = 3.88e-3  # [rad/s]


class NetworkCfg(ModelCfg):
    """Settings of :func:`~legged_torque.motors.formulas.network`, a network from logged data.

    Its file is JSON, numbers and a name alone, so that nothing in it can run: ``{"activation": "softsign", "layers":
    [...]}``. It is read once; then the settings have its contents, runs and exports with them, and ``file`` is empty.
    """

    _motor_class = "legged_torque.motors.models:NetworkModel"
    _model, _others = "network", ("draws", "file", "step", "history", "activation", "layers")
    file: str = ""  # absolute, below resources/, or relative to the current directory
    activation: Literal["softsign", "tanh", "relu", "elu", "softplus"] = "softsign"  # between layers; of the file
    layers: list[list[list[float]]] = []  # of the file; a row per output of a layer: weights, then the bias
    history: Annotated[list[int], Limits(0, 100, nonempty=True)] = [0, 1, 2]  # ages of inputs [physics steps]
    step: Positive = 0.005  # [s] between inputs in the logs, which must be the physics step
    position_scale: float | dict[str, float] = 1.0  # of errors of the target; -1 for logs of pos - target
    velocity_scale: float | dict[str, float] = 1.0  # of joint velocities
    torque_scale: float | dict[str, float] = 1.0  # of the output

    def constants(self, dof_names: Sequence[str], path: str) -> dict[str, list[float]]:
        """Return the scales; a UserError if the network cannot be read, or is of another size."""
        self._read(path)
        sizes = [2 * len(self.history), *map(len, self.layers)]
        for number, (rows, inputs) in enumerate(zip(self.layers, sizes, strict=False), 1):
            for wrong in {len(row) - 1 for row in rows} - {inputs}:
                expected = f"{inputs} inputs" + (", two per entry of history" if number == 1 else "")
                raise UserError(f"layer {number} of {path} must have {expected}, not {wrong}")
        if sizes[-1] != 1 or not self.layers:
            raise UserError(f"the last layer of {path} must have one output, the torque of a joint, not {sizes[-1]}")
        return super().constants(dof_names, path)

    def whole(self, array: Callable[[Any], Any], dt: float) -> dict[str, Any]:
        """Return the network; a UserError if it is for another physics step."""
        if abs(dt - self.step) > 1e-5 * self.step:
            raise UserError(f"the network of the motors is for physics steps of {self.step:g} s (step), not {dt:g} s")
        layers = [array(layer) for layer in self.layers]
        return {"history": self.history, "activation": self.activation, "layers": layers}

    def describe(self) -> dict[str, Any]:
        """Return model, constants and network for ``policy.yaml``."""
        self._read("motors.network")
        return super().describe() | {name: getattr(self, name) for name in ("step", "history", "activation", "layers")}

    def _read(self, path: str) -> None:
        """Read the file if there is one to read; a UserError if it is no network."""
        if self.file:
            content = read_data(resource_path(self.file), {"activation", "layers"}, "docs/howto/motor.md")
            update_from_dict(self, {name: content[name] for name in ("activation", "layers")}, path)
            if sum(len(row) for layer in self.layers for row in layer) > MOST_WEIGHTS:
                raise UserError(f"'{self.file}' must have at most {MOST_WEIGHTS} numbers, which settings can hold")
            self.file = ""
        elif not self.layers:
            raise UserError(f"{path}.file must name the file of the network, see docs/howto/motor.md")


_ALL = (IdealCfg, CurveCfg, DriveCfg, LagCfg, FrictionCfg, ThermalCfg, QuantizeCfg, MuscleCfg, EncoderCfg, NetworkCfg)
MODELS = {cfg._model: cfg for cfg in _ALL}
"""Settings by the name of the model."""


class JointsCfg(Section):
    """What joints have besides motors, in place of what the robot's file says; None leaves that as it is."""

    armature: PerJoint | None = None  # [kg m^2] of the rotors through their gears, in place of a curve's, too
    damping: PerJoint | None = None  # [N m s/rad] viscous friction
    frictionloss: PerJoint | None = None  # [N m] Coulomb friction


class MotorsCfg(Section):
    """Named chains of links, and links that act only in a chain that lists them."""

    choices: dict[str, list[str]] = {"ideal": ["delay", "ideal"]}  # chains by name, for ``--motors``
    ideal = IdealCfg  # any torque within the limits, at once
    drive = DriveCfg  # gains that the drive itself closes
    lag = LagCfg  # torques rise in a while
    friction = FrictionCfg  # in addition to that of the robot's file
    thermal = ThermalCfg  # less torque after a long load
    quantize = QuantizeCfg  # steps of torques
    encoder = EncoderCfg  # steps of measurements, for policy, control law and the links before it
    network = NetworkCfg  # a network from logged data, in torch
    joints = JointsCfg  # no link: inertia and friction of joints

    def choose(self, name: str) -> None:
        """Make one of :attr:`choices` the chain; links of the control law stay. A UserError if there is none."""
        check_names("motors", [name], self.choices)
        chosen, links = self.choices[name], {link: getattr(self, link, None) for link in self.chain}
        kept = [key for key, link in links.items() if getattr(link, "_of_law", False) and key not in chosen]
        before = itertools.takewhile(lambda link: not isinstance(getattr(self, link, None), ModelCfg), chosen)
        place = len(list(before))  # behind what acts on actions
        self.chain: list[str] = [*chosen[:place], *kept, *chosen[place:]]

    def restore(self, described: dict[str, dict[str, Any]]) -> None:
        """Take chain and constants of ``policy.yaml``; delays stay. A UserError if a link is none of the task's."""
        delays = [name for name in self.chain if isinstance(getattr(self, name, None), DelayCfg)]
        for name, values in described.items():
            link, path = getattr(self, name, None), f"motors.{name}"
            if not isinstance(link, ModelCfg) or link._model != values.get("model"):
                raise UserError(f"the policy's task has no {path} of the model '{values.get('model')}'")
            if isinstance(link, NetworkCfg):
                link.file = ""  # of the task's network
            update_from_dict(link, {key: value for key, value in values.items() if key != "model"}, path)
        self.chain = [*delays, *(described or ["ideal"])]

    def of_joints(self, dof_names: Sequence[str]) -> dict[str, dict[str, float]]:
        """Return armature [kg m^2], damping [N m s/rad] and frictionloss [N m] by joint, where not those of the file.

        An armature is that of :attr:`joints`, or of the last motor in the chain that has one.
        """
        of_chain = ((f"{name}.armature", getattr(getattr(self, name, None), "armature", None)) for name in self.chain)
        settings = [*of_chain, *((f"joints.{name}", value) for name, value in to_dict(self.joints).items())]
        return {
            path.rpartition(".")[2]: dict(zip(dof_names, by_joint(f"motors.{path}", value, dof_names), strict=True))
            for path, value in settings
            if value is not None
        }

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return the chain as ``MotorChain.describe`` does, but without delays; a UserError names an unknown link."""
        known = [name for name, value in vars(self).items() if isinstance(value, MotorCfg)]
        check_names("motors.chain", self.chain, known)
        links = ((name, getattr(self, name)) for name in self.chain)
        return {name: link.describe() for name, link in links if not isinstance(link, (DelayCfg, PerturbationCfg))}
