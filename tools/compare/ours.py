"""Our side of the comparison: ``go1_position`` on a plane in ``low``, without mirror images if settings are equal."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from legged_torque import resource_path
from legged_torque.benchmark.measure import build
from legged_torque.deploy.export import export_policy, nominal_cfg
from legged_torque.deploy.policy import Policy
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.envs import task_registry
from legged_torque.utils.files import write_json
from legged_torque.utils.options import Options
from legged_torque.utils.runs import checkpoint_file, package_versions
from tools.compare import measure

TASK = "go1_position"


class Go1:
    """An exported policy and its robot."""

    def __init__(self, folder: Path, iterations: int = 100) -> None:
        """Load an export; MuJoCo's solver makes so many iterations at most."""
        self._policy = Policy(folder)
        description = self._policy.description
        self._robot = MujocoRobot(resource_path(description["robot"]["file"]), description)
        self._decimation, self._start = description["timing"]["decimation"], description["initial_state"]
        self.control_step = 1.0 / description["timing"]["control_frequency"]
        self.model, self.data = self._robot.model, self._robot.data
        self.model.opt.iterations = iterations

    def reset(self) -> None:
        """Stand in the initial pose, at rest."""
        pose, upright = self._policy.nominal_pose, np.array([1.0, 0.0, 0.0, 0.0])
        self._robot.reset(self._start["trunk_position"], upright, pose, (np.zeros(3), np.zeros(3), 0.0 * pose))
        self._policy.reset()

    def step(self, command: np.ndarray) -> None:
        """Make a control step."""
        actions = self._policy.act(self._policy.observation(self._robot.state(), command))
        for _ in range(self._decimation):
            pos, vel = self._robot.joint_positions(), self._robot.joint_velocities()
            self._robot.step(self._policy.torques(actions, pos, vel))


def changes(equal: bool, engine: str) -> list[str]:
    """Return settings to change: commands as narrow as the other side's, and what is equal if it is meant to be."""
    limits, options = [-measure.YAW_RATE, measure.YAW_RATE], measure.EQUAL
    common = [f"sim.engine={engine}", "evaluation.interval=0", f"runner.save_interval={measure.INTERVAL}"]
    common += [f"commands.ranges.ang_vel_yaw={limits}", f"runner.num_steps_per_env={measure.NUM_STEPS}"]
    common += [f"{network}.hidden_dims={measure.NETWORKS}" for network in ("actor", "critic")]
    common += [f"algorithm.num_learning_epochs={measure.EPOCHS}", f"algorithm.num_mini_batches={measure.MINIBATCHES}"]
    same = [f"sim.solver_iterations={options['iterations']}", f"sim.ls_iterations={options['ls_iterations']}"]
    return common + ([*same, "algorithm.symmetry_cfg.use_data_augmentation=False"] if equal else [])


def main() -> None:
    """Train, time ``env.step``, and evaluate checkpoints until one tracks enough."""
    args = measure.parse_args()
    words = changes(args.settings == "equal", args.engine)
    options = Options(num_envs=args.num_envs, seed=args.seed, perturbation="low", set=words)
    cfgs = task_registry.get_cfgs(TASK, options)
    task, runner = build(TASK, cfgs, args.device, str(args.out.parent))
    recorder = measure.Recorder(runner, args.started)
    runner.learn(args.iterations, init_at_random_ep_len=True)
    actions = 0.5 * torch.randn(args.num_envs, task.num_actions, device=args.device)
    step = measure.step_ms(lambda: task.step(actions), lambda: wp.synchronize_device(args.device))
    result = {"settings": words, "versions": package_versions(), "step_ms": step}
    result |= recorder.summary(args.num_envs)
    folder = Path(runner.logger.log_dir)
    write_json(args.out, result | measure.time_until_enough(recorder, walkers(cfgs, folder, args), args.num_envs))


def walkers(cfgs: tuple, folder: Path, args: Any) -> Iterator[tuple[int, Go1]]:
    """Yield the policies of the run in a folder in order, each exported."""
    task, runner = build(TASK, (nominal_cfg(cfgs[0]), cfgs[1]), args.device, str(args.out.parent / "exports"))
    for iterations in range(measure.INTERVAL, args.iterations + 1, measure.INTERVAL):
        runner.load(str(checkpoint_file(folder, iterations)))
        training = {"run": folder.name, "checkpoint": "", "iterations": iterations, "total_steps": 0}
        export_policy(task, runner.alg.policy(), args.out.parent / "exported", TASK, training)
        yield iterations, Go1(args.out.parent / "exported", cfgs[0].sim.solver_iterations)


if __name__ == "__main__":
    main()
