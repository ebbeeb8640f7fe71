"""Compare solver settings with converged mj_step on a walking robot: ``python scripts/physics_accuracy.py``."""

from legged_torque.utils.interrupt import end_on_interrupt
from legged_torque.utils.rendering import without_renderer

end_on_interrupt()
without_renderer()  # before anything imports mujoco

import torch

from legged_torque.checks.accuracy import copy_state, reference_velocities, velocity_errors
from legged_torque.envs import task_registry
from legged_torque.sim.simulator import Simulator
from legged_torque.utils.args import Parser, add_task_args, options_of
from legged_torque.utils.cli import check_at_least, run_script
from legged_torque.utils.task_registry import set_seed

SETTINGS = [(engine, *numbers) for engine in ("fused", "mujoco_warp") for numbers in ((10, 20), (5, 8), (3, 6))]
"""Engine, solver iterations and line search iterations."""


def main() -> None:
    """Let a trained policy walk, keep its states, and step each with every setting."""
    parser = Parser(__doc__)
    add_task_args(parser)
    parser.set_defaults(num_envs=32, seed=1)
    help_text = "control steps to walk; one physics step of each is compared"
    parser.add_argument("--steps", type=int, default=100, help=help_text)
    args = parser.parse_args()
    check_at_least(args, 1, "steps")
    options = options_of(args)
    run = task_registry.load_run(options)
    set_seed(args.seed)
    env, runner = task_registry.make_loaded(run, options)
    policy = runner.get_inference_policy(env.device)
    states, obs = [], env.get_observations()
    with torch.inference_mode():
        for _ in range(args.steps):
            obs = env.step(policy(obs))[0]
            states.append(copy_state(env.sim))
    reference = reference_velocities(env.sim.mj_model, states)
    print("engine      | iterations | line search | rms error | 99.9% | max | rms change in a step   [m/s, rad/s]")
    for engine, iterations, ls_iterations in SETTINGS:
        sim = Simulator(env.sim.mj_model, env.num_envs, env.device, engine, iterations, ls_iterations)
        errors = " | ".join(f"{value:.2e}" for value in velocity_errors(sim, states, reference).values())
        print(f"{engine:<11} | {iterations:>10} | {ls_iterations:>11} | {errors}")


if __name__ == "__main__":
    run_script(main)
