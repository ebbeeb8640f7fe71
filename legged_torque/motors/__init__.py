"""What stands between the torques that a policy asks for and those that the joints get."""

from torch import Tensor

from legged_torque.motors.ideal import IdealMotors
from legged_torque.motors.motors import Motors
from legged_torque.utils.errors import unknown_name

MOTORS: dict[str, type[Motors]] = {"ideal": IdealMotors}  # models of motors, by ``motors.model``


def make_motors(model: str, num_envs: int, limits: Tensor) -> Motors:
    """Return the motors of ``motors.model``; ``limits`` are lowest and highest torques [N m]. Shape: (2, num_dof)."""
    if model not in MOTORS:
        raise unknown_name("motors.model", model, MOTORS)
    return MOTORS[model](num_envs, limits)
