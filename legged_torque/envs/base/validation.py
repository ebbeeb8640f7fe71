"""Validate the settings of a task before anything is built, and note those that have no effect."""

from collections.abc import Iterator

from legged_torque.envs.base.clocks import delays
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.motors.config import DelayCfg, MotorCfg, PerturbationCfg
from legged_torque.motors.model_config import DriveCfg, EncoderCfg, FrictionCfg, LagCfg, NetworkCfg, QuantizeCfg
from legged_torque.terrain.layout import Layout
from legged_torque.utils.config import to_dict
from legged_torque.utils.errors import UserError, check_names

LIMITLESS = (DelayCfg, DriveCfg, EncoderCfg, FrictionCfg, LagCfg, NetworkCfg, PerturbationCfg, QuantizeCfg)
"""Links behind which torques may be any."""


def check_env_cfg(cfg: LeggedRobotCfg) -> None:
    """Raise a UserError that names the first setting of a task that makes no sense, alone or with others."""
    cfg.check()
    if cfg.sim.engine not in ("fused", "mujoco_warp"):
        _check_engine(cfg)
    for pair in cfg.asset.mirrored_legs:
        if len(pair) != 2:
            raise UserError(f"asset.mirrored_legs must be pairs [right, left], not {pair}")
    for name in ("symmetry", "single_stance"):
        if getattr(cfg.rewards.scales, name) and not cfg.asset.mirrored_legs:
            raise UserError(f"rewards.scales.{name} needs asset.mirrored_legs: which legs are right and left of a pair")
    if cfg.rewards.scales.base_height and not cfg.rewards.base_height_target > 0.0:
        raise UserError(f"rewards.base_height_target must be greater than 0, not {cfg.rewards.base_height_target}")
    if cfg.commands.curriculum and cfg.commands.fixed is not None:
        raise UserError("commands.curriculum has no effect with commands.fixed: set one of them")
    if cfg.terrain.mesh_type == "heightfield":
        _check_map(cfg)
    parameters = cfg.random_parameters()
    check_names("parameter in domain_rand.keep_fixed", cfg.domain_rand.keep_fixed, parameters)
    for path, delay in delays(cfg).items():
        is_in_steps = (delay.range[1] or delay.jitter) and delay.unit != "control_steps"
        if is_in_steps and path.removeprefix("motors.") in cfg.motors.chain and not cfg.control.refresh_torques:
            why = "control.refresh_torques is off: torques are computed once per control step"
            raise UserError(f"{path}.unit must be control_steps, since {why}")


def _check_engine(cfg: LeggedRobotCfg) -> None:
    """Refuse an engine of a user's that lacks what the settings need."""
    from legged_torque.sim.engine import require  # takes seconds, which only such engines are worth
    from legged_torque.sim.registry import engine_class

    engine = engine_class(cfg.sim.engine)
    if cfg.domain_rand.randomize_parameters:
        require(engine, "per_world", "domain_rand.randomize_parameters")
    if cfg.asset.self_collisions:
        require(engine, "self_collision", "asset.self_collisions")


def _check_map(cfg: LeggedRobotCfg) -> None:
    """Refuse a map that cannot be, levels that it does not have, and a scan that leaves it."""
    settings = cfg.terrain
    Layout.of(settings)
    if settings.curriculum and settings.max_init_terrain_level >= settings.num_rows:
        most = f"at most {settings.num_rows - 1}, since terrain.num_rows is {settings.num_rows}"
        raise UserError(f"terrain.max_init_terrain_level must be {most}, not {settings.max_init_terrain_level}")
    for name in ("measured_points_x", "measured_points_y"):
        farthest = max(abs(place) for place in getattr(settings, name))
        if farthest > settings.border_size:
            most = f"at most terrain.border_size, {settings.border_size}, either way"
            raise UserError(f"terrain.{name} must be {most}, not {farthest}")


def notes_on(cfg: LeggedRobotCfg) -> Iterator[str]:
    """Yield notes: a height scan of a plane, a chain of motors without limits, and settings of motors outside it."""
    if cfg.terrain.measure_heights and cfg.terrain.mesh_type == "plane":
        yield "terrain.measure_heights has no effect: terrain.mesh_type is plane"
    if all(isinstance(getattr(cfg.motors, name, None), LIMITLESS) for name in cfg.motors.chain):
        yield "no link of motors.chain limits torques: rewards and metrics count more than the joints get"
    for name, link in vars(cfg.motors).items():
        kind = DelayCfg if isinstance(link, DelayCfg) else type(link)
        is_set = isinstance(link, MotorCfg) and to_dict(link) != to_dict(kind())
        if is_set and name not in cfg.motors.chain:
            yield f"motors.{name} has no effect: motors.chain lacks '{name}'"
