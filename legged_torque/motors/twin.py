"""Motors in numpy, as ``policy.yaml`` describes them: for simulations without torch."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from legged_torque.motors.config import check_single
from legged_torque.motors.formulas import FORMULAS
from legged_torque.motors.model_config import MODELS
from legged_torque.utils.config import update_from_dict
from legged_torque.utils.errors import UserError


class MotorTwin:
    """The motors of one robot behind its control law; limits alone if ``policy.yaml`` names no motors.

    Call :meth:`begin` before each control step, :meth:`apply` at each physics step and :meth:`reset` before an episode.
    """

    def __init__(self, description: dict[str, Any]) -> None:
        """Read the sections ``motors``, ``joint_order``, ``torque_limits``, ``nominal_pose``, ``gains`` and ``timing``.

        A UserError names a motor without a function here, and constants that make no sense.
        """
        names, timing = description["joint_order"], description["timing"]
        limits = np.array([description["torque_limits"][name] for name in names], np.float32).T
        robot = {"lowest_torque": limits[0], "highest_torque": limits[1], "decimation": timing["decimation"]}
        robot |= {"dt": np.float32(1.0 / timing["physics_frequency"])}
        by_joint = {"nominal_pose": description["nominal_pose"]}
        by_joint |= {"p_gains": description["gains"]["stiffness"], "d_gains": description["gains"]["damping"]}
        robot |= {key: np.array([values[name] for name in names], np.float32) for key, values in by_joint.items()}
        links = description.get("motors") or {"ideal": {"model": "ideal"}}
        self._links = []
        for link, described in links.items():
            if without_function(described):
                raise UserError(f"no numpy function for the motor '{link}'")
            motor = SimpleNamespace(**robot, **constants(described, names, f"motors.{link}", robot["dt"]))
            self._links.append((FORMULAS[described["model"]], motor))
        encoders = [link for link, described in links.items() if described["model"] == "encoder"]
        check_single("motors", "encoder", encoders)
        self._shape = (len(names),)
        self.reset()

    def reset(self) -> None:
        """Start an episode: forget what motors keep from step to step."""
        for formula, motor in self._links:
            shape = (*self._shape, *formula.inner(motor))
            vars(motor).update({name: np.zeros(shape, np.float32) for name in formula.state})

    def begin(self) -> None:
        """Begin a control step."""
        for formula, motor in self._links:
            if formula.begin:
                vars(motor).update(formula.begin(np, motor))

    def apply(self, wanted: np.ndarray, pos: np.ndarray, vel: np.ndarray) -> np.ndarray:
        """Return the torques that joints get of those that a control law asks for [N m].

        Joint positions [rad] and velocities [rad/s] are the present ones. Shapes: (joints,).
        """
        torques, pos, vel = (np.asarray(values, np.float32) for values in (wanted, pos, vel))
        state = self.measured(pos, vel)
        for formula, motor in self._links:
            if formula.is_encoder:
                state = pos, vel
            else:
                torques, kept = formula.function(np, motor, torques, *state)
                vars(motor).update(kept)
        return torques

    def before_friction(self, torques: np.ndarray) -> np.ndarray:
        """Return what motors have made of torques that joints have got in a physics step [N m]. Shape: (joints,)."""
        return torques + sum(motor.lost for formula, motor in self._links if "lost" in formula.state)

    def measured(self, pos: np.ndarray, vel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what control laws have of joint positions [rad] and velocities [rad/s]. Shapes: (joints,)."""
        for formula, motor in self._links:
            if formula.is_encoder:
                return formula.function(np, motor, np.asarray(pos, np.float32), np.asarray(vel, np.float32))
        return pos, vel


def without_function(described: dict[str, Any]) -> bool:
    """Return whether a motor of ``policy.yaml`` is of a model that is not known here."""
    return str(described.get("model")) not in FORMULAS


def constants(described: dict[str, Any], names: list[str], path: str, dt: float) -> dict[str, Any]:
    """Return constants by name; a UserError names those that do not exist or make no sense. Shapes: (joints,)."""
    cfg = MODELS[described["model"]]()
    update_from_dict(cfg, {name: value for name, value in described.items() if name != "model"}, path)
    cfg.check(path)
    constants = {name: np.array(values, np.float32) for name, values in cfg.constants(names, path).items()}
    return constants | cfg.whole(np.float32, dt)
