"""Validate the settings of a task before anything is built."""

from __future__ import annotations

from operator import attrgetter

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.motors.action_delay import UNITS
from legged_torque.utils.config import to_dict
from legged_torque.utils.errors import UserError, unknown_name

POSITIVE = (
    *("trunk_mass_scale", "foot_radius", "dof_damping", "dof_armature", "dof_stiffness", "dof_frictionloss"),
    *("ground_friction", "contact_stiffness", "contact_damping"),
    *("motor_strength", "stiffness_scale", "damping_scale"),
)
"""Ranges of ``domain_rand`` that make no sense below 0."""

NOT_PARAMETERS = ("keep_fixed", "push_velocity", "action_delay")
"""Lists in ``domain_rand`` that ``keep_fixed`` cannot name; nor can it name initial states."""


def check_env_cfg(cfg: LeggedRobotCfg) -> None:
    """Raise a UserError that names the first setting of a task that makes no sense."""
    counts = ("env.num_envs", "env.history_length", "control.decimation", "sim.solver_iterations", "sim.ls_iterations")
    for key in counts:
        if attrgetter(key)(cfg) < 1:
            raise UserError(f"{key} must be at least 1, not {attrgetter(key)(cfg)}")
    for key in ("sim.dt", "env.episode_length_s"):
        if not attrgetter(key)(cfg) > 0.0:
            raise UserError(f"{key} must be greater than 0, not {attrgetter(key)(cfg)}")
    if len(cfg.init_state.pos) != 3:
        raise UserError(f"init_state.pos must be [x, y, z], not {cfg.init_state.pos}")
    if cfg.rewards.scales.symmetry and not cfg.asset.mirrored_legs:
        raise UserError("rewards.scales.symmetry needs asset.mirrored_legs: which legs are right and left of a pair")
    if cfg.rewards.scales.base_height and not cfg.rewards.base_height_target > 0.0:
        raise UserError(f"rewards.base_height_target must be greater than 0, not {cfg.rewards.base_height_target}")
    _check_probability("commands.resampling_probability", cfg.commands.resampling_probability)
    for key, error in to_dict(cfg.noise.noise_scales).items():
        if error < 0.0:
            raise UserError(f"noise.noise_scales.{key} must not be negative, it is {error}")
    for key in POSITIVE:
        limits = getattr(cfg.domain_rand, key)
        if limits is not None and min(limits) < 0.0:
            raise UserError(f"domain_rand.{key} must not be negative, it is {limits}")
    ranges = [key for key, value in to_dict(cfg.domain_rand).items() if isinstance(value, list)]
    ranges = [key for key in ranges if key not in NOT_PARAMETERS and not key.startswith("init_")]
    for name in cfg.domain_rand.keep_fixed:
        if name not in ranges:
            raise unknown_name("range in domain_rand.keep_fixed", name, ranges)
    for name, section in {"commands.ranges": cfg.commands.ranges, "domain_rand": cfg.domain_rand}.items():
        for key, value in to_dict(section).items():
            if key.endswith("probability"):
                _check_probability(f"{name}.{key}", value)
            elif isinstance(value, list) and key != "keep_fixed":
                _check_range(f"{name}.{key}", value)
    _check_action_delay(cfg)


def _check_action_delay(cfg: LeggedRobotCfg) -> None:
    """Refuse delays that are not whole steps, or that torques cannot follow."""
    rand = cfg.domain_rand
    if rand.action_delay_unit not in UNITS:
        raise unknown_name("domain_rand.action_delay_unit", rand.action_delay_unit, UNITS)
    if not all(isinstance(steps, int) and steps >= 0 for steps in rand.action_delay):
        raise UserError(f"domain_rand.action_delay must be two whole numbers from 0 on, not {rand.action_delay}")
    if rand.action_delay[1] and rand.action_delay_unit == "physics_steps" and not cfg.control.refresh_torques:
        raise UserError(
            "domain_rand.action_delay_unit must be control_steps, since control.refresh_torques is off: torques are "
            "computed once per control step"
        )


def _check_probability(key: str, value: float) -> None:
    """Refuse what is not a probability."""
    if not 0.0 <= value <= 1.0:
        raise UserError(f"{key} must be from 0 to 1, not {value}")


def _check_range(key: str, limits: list[float]) -> None:
    """Refuse what is not a pair of a minimum and a maximum."""
    if len(limits) != 2 or not limits[0] <= limits[1]:
        raise UserError(f"{key} must be [minimum, maximum], not {limits}")
