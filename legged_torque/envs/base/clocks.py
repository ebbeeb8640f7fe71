"""The clocks of a task, in Hz: how often its policy acts, and how often its physics and motors step."""

from typing import Any

from legged_torque.motors.config import DelayCfg, LatencyCfg
from legged_torque.utils.errors import UserError


def set_clocks(cfg: Any, policy_hz: float | None, physics_hz: float | None) -> float:
    """Set ``sim.dt`` and ``control.decimation`` of a task's settings, and what they count in steps to the same time.

    Returns how many control steps take the place of one.

    Args:
        cfg: Settings, a :class:`~legged_torque.envs.base.legged_robot_config.LeggedRobotCfg`.
        policy_hz: Control steps per second; None keeps them.
        physics_hz: Physics steps per second; None keeps them.

    Raises:
        UserError: If the rates do not divide, or a number of steps would not be whole.
    """
    dt, decimation = cfg.sim.dt, cfg.control.decimation
    physics, policy = physics_hz or 1.0 / dt, policy_hz or 1.0 / (dt * decimation)
    name, given = ("--policy_hz", policy) if policy_hz else ("--physics_hz", physics)
    if (steps := round(physics / policy)) < 1 or abs(physics / policy - steps) > 1e-6 * steps:
        rule = f"divide that of the physics, {physics:g}" if policy_hz else f"be a multiple of the policy's, {policy:g}"
        raise UserError(f"{name} must {rule} Hz, not {given:g}")
    cfg.sim.dt, cfg.control.decimation = 1.0 / physics if physics_hz else dt, steps
    per_physics, per_control = dt / cfg.sim.dt, dt * decimation / (cfg.sim.dt * steps)
    for path, delay in delays(cfg).items():
        ratio = {"physics_steps": per_physics, "control_steps": per_control}.get(delay.unit, 1.0)
        delay.range = [whole_steps(f"{path}.range", value * ratio) for value in delay.range]
        delay.jitter = whole_steps(f"{path}.jitter", delay.jitter * ratio)
    cfg.terrain.measure_delay = whole_steps("terrain.measure_delay", cfg.terrain.measure_delay * per_control)
    cfg.commands.resampling_probability = min(cfg.commands.resampling_probability / per_control, 1.0)
    for name in ("resampling_probability", "push_probability"):
        setattr(cfg.domain_rand, name, min(getattr(cfg.domain_rand, name) / per_control, 1.0))
    return per_control


def delays(cfg: Any) -> dict[str, LatencyCfg]:
    """Return settings of delays by path: of all links of motors, in the chain or not, and of sensing."""
    links = {f"motors.{name}": link for name, link in vars(cfg.motors).items() if isinstance(link, DelayCfg)}
    return links | {"sensing.delay": cfg.sensing.delay}


def whole_steps(path: str, steps: float) -> int:
    """Return a number of steps; a UserError that names the setting if they are not whole."""
    if abs(steps - round(steps)) > 1e-6 * max(steps, 1.0):
        raise UserError(f"{path} must be whole steps, not {steps:g}, which --policy_hz and --physics_hz make of it")
    return round(steps)
