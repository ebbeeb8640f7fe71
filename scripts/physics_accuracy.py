"""Compare a physics step with converged mj_step in ten kinds of states: ``python scripts/physics_accuracy.py``.

The states are made from those of a robot that walks under a trained policy. On rough ground they are five kinds, and
compared are those in which only feet are near the ground, and where it is a plane near each: plain MuJoCo has such a
plane for each foot.
"""

from legged_torque import resource_path
from legged_torque.envs import task_registry
from legged_torque.utils.args import Parser, add_task_args, options_of
from legged_torque.utils.cli import check_at_least, run_script, slow_imports
from legged_torque.utils.devices import device_name
from legged_torque.utils.task_registry import set_seed

WALKERS = 32  # worlds that walk


def main() -> None:
    """Let a trained policy walk, keep its states, make the others of them, and step each with both engines."""
    parser = Parser(__doc__)
    add_task_args(parser)
    parser.set_defaults(num_envs=WALKERS, seed=1)
    parser.add_argument("--steps", type=int, default=100, help="control steps to walk; the states after each are kept")
    parser.add_argument("--worlds", type=int, default=1500, help="states of each kind; default: %(default)s")
    args = parser.parse_args()
    check_at_least(args, 1, "steps", "worlds")
    options = options_of(args)
    with slow_imports():
        run = task_registry.load_run(options)
        import torch

        from legged_torque.envs.base.asset import load_asset
        from legged_torque.sim.registry import ENGINES, make_engine
        from legged_torque.utils.mjcf import read_spec
        from tools.accuracy import (
            KINDS,
            ON_ANY_GROUND,
            TOLERANCE,
            PhysicsState,
            copy_state,
            make_states,
            measure_accuracy,
            open_motors,
            reference_step,
        )
        from tools.planes import PlanePerFoot
    set_seed(args.seed)
    env, runner = task_registry.make_loaded(run, options)
    policy = runner.get_inference_policy(env.device)
    kept: list[PhysicsState] = []
    obs = env.get_observations()
    with torch.inference_mode():
        for _ in range(args.steps):
            obs = env.step(policy(obs))[0]
            kept.append(copy_state(env.sim))
    walking = {name: torch.cat([state[name] for state in kept]) for name in kept[0]}
    limits, ground, sims, pose = (env.cfg.sim.solver_iterations, env.cfg.sim.ls_iterations), env.terrain.map, {}, None
    for name, engine in ENGINES.items():
        height_map = ground if "height_map" in engine.capabilities else None
        model = open_motors(load_asset(env.cfg, None if height_map else env.terrain).mj_model)
        sims[name] = make_engine(name, model, args.worlds, env.device, *limits, height_map)
    if ground:
        spec = read_spec(resource_path(env.cfg.asset.file), env.dof_names)
        planes = PlanePerFoot(spec, env.foot_names, ground)
        model, pose = open_motors(planes.model), planes.pose
        model.opt.timestep = env.cfg.sim.dt
    print(f"{args.task} on {device_name(env.device)}: errors of the velocities after one step [m/s, rad/s]")
    print(f"of {args.worlds} worlds each; {limits[0]} iterations of the solver, {limits[1]} of its line search")
    titles = ("kind", "engine", "median", "99.9%", "max", f"> {TOLERANCE:g}", "left out", "iterations")
    print("{:<21} | {:<11} | {:>7} | {:>7} | {:>7} | {:>7} | {:>8} | {:>10}".format(*titles))
    for kind in ON_ANY_GROUND if ground else KINDS:
        states = make_states(kind, model, walking, args.worlds, args.seed)
        expected = reference_step(model, states, pose)
        for engine, sim in sims.items():
            row = measure_accuracy(sim, states, *expected)
            errors = " | ".join(f"{value:7.1e}" for value in (row.median, row.p999, row.max))
            shares = f"{row.wrong:7.2%} | {row.left_out:8.2%} | {row.iterations:10.1f}"
            print(f"{kind:<21} | {engine:<11} | {errors} | {shares}", flush=True)


if __name__ == "__main__":
    run_script(main)
