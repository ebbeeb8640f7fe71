"""The physics engines by name."""

import mujoco

from legged_torque.sim.engine import Engine, HeightMap, require
from legged_torque.sim.fused.engine import FusedEngine
from legged_torque.sim.graph import prepare_device
from legged_torque.sim.mjwarp import MuJoCoWarpEngine
from legged_torque.sim.robot_file import actuator_problems
from legged_torque.utils.errors import check_names, refuse

ENGINES: dict[str, type[Engine]] = {engine.name: engine for engine in (FusedEngine, MuJoCoWarpEngine)}
"""Values of ``sim.engine``. A user's file may add an engine."""


def engine_class(name: str) -> type[Engine]:
    """Return the engine of this name; a UserError if there is none."""
    check_names("sim.engine", [name], ENGINES)
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

    The constraint solver does at most so many iterations per physics step, and its line search per iteration. A
    UserError if the engine is unknown, lacks what is needed, or cannot simulate this robot.
    """
    engine = engine_class(name)
    refuse(list(actuator_problems(model)), f"sim.engine '{name}' needs motors")
    prepare_device(device)  # of Warp, which draws at random and checks numbers with any engine
    model.opt.iterations, model.opt.ls_iterations = solver_iterations, ls_iterations
    if height_map is None:
        return engine(model, num_envs, device)
    require(engine, "height_map", "a height map")
    return engine(model, num_envs, device, height_map=height_map)
