"""The physics engines by name."""

from __future__ import annotations

from typing import Any

import mujoco

from legged_torque.sim.engine import Engine, require
from legged_torque.sim.fused.engine import FusedEngine
from legged_torque.sim.height_map import HeightMap
from legged_torque.sim.mjwarp import MuJoCoWarpEngine
from legged_torque.sim.robot_file import actuator_problems
from legged_torque.utils.errors import refuse, unknown_name

ENGINES: dict[str, type[Engine]] = {engine.name: engine for engine in (FusedEngine, MuJoCoWarpEngine)}
"""Values of ``sim.engine``. A user's file may add an engine."""


def engine_class(name: str) -> type[Engine]:
    """Return the engine of this name; a UserError if there is none."""
    if name not in ENGINES:
        raise unknown_name("sim.engine", name, ENGINES)
    return ENGINES[name]


def make_engine(
    name: str,
    model: mujoco.MjModel,
    num_envs: int,
    device: str = "cpu",
    solver_iterations: int = 30,
    ls_iterations: int = 20,
    height_map: HeightMap | None = None,
) -> Engine:
    """Build the worlds of an engine on "cpu" or "cuda:N", see :class:`Engine`.

    A UserError if the engine is unknown, lacks what is needed, or cannot simulate this robot.
    """
    engine = engine_class(name)
    refuse(list(actuator_problems(model)), f"sim.engine '{name}' needs motors")
    options: dict[str, Any] = {}
    if height_map is not None:
        require(engine, "height_map", "a height map")
        options["height_map"] = height_map
    return engine(model, num_envs, device, solver_iterations, ls_iterations, **options)
