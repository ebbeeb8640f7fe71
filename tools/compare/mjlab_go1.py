"""mjlab's side of the comparison: its own Go1 on flat ground; runs in an environment that has mjlab 1.6."""

import importlib.metadata
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mjlab.tasks  # noqa: F401  registers them
import mujoco
import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.torch import configure_torch_backends
from tensordict import TensorDict

from legged_torque.utils.files import write_json
from tools.compare import measure

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
OBSERVED = ("base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos", "joint_vel", "actions", "command")
PACKAGES = ("mjlab", "mujoco", "mujoco-warp", "warp-lang", "torch", "rsl-rl-lib")


class Go1:
    """A policy of mjlab, and its robot: the model of the task, with its position actuators."""

    def __init__(self, env: ManagerBasedRlEnv, policy: Any) -> None:
        """Take the model of a task."""
        terms = env.observation_manager.active_terms["actor"]
        if tuple(terms) != OBSERVED:
            raise SystemExit(f"this version of mjlab observes {', '.join(terms)}, not {', '.join(OBSERVED)}")
        self.model, self._policy = env.sim.mj_model, policy
        self.data, self.control_step = mujoco.MjData(self.model), env.step_dt
        self._decimation = env.cfg.decimation
        robot, action = env.scene["robot"], env.action_manager.get_term("joint_pos")
        index = robot.indexing
        self._qpos, self._dofs = (address.cpu().numpy() for address in (index.joint_q_adr, index.joint_v_adr))
        self._default = robot.data.default_joint_pos[0].cpu().numpy()
        self._root = robot.data.default_root_state[0, :7].cpu().numpy()
        self._scale, self._offset = (values[0].cpu().numpy() for values in (action.scale, action.offset))
        driven = index.joint_ids[action.target_ids].cpu().tolist()
        self._order = [driven.index(joint) for joint in self.model.actuator_trnid[:, 0]]  # of actuators

    def reset(self) -> None:
        """Stand in the initial pose, at rest."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:7], self.data.qpos[self._qpos] = self._root, self._default
        mujoco.mj_forward(self.model, self.data)
        self._last_action = np.zeros(len(self._order))

    def observation(self, command: np.ndarray) -> np.ndarray:
        """Return what the actor observes, in the order of :data:`OBSERVED`."""
        data, up = self.data, np.zeros(9)
        mujoco.mju_quat2Mat(up, data.qpos[3:7])
        velocities = [data.sensor(f"robot/imu_{kind}_vel").data for kind in ("lin", "ang")]
        joints = [data.qpos[self._qpos] - self._default, data.qvel[self._dofs]]
        return np.concatenate([*velocities, -up.reshape(3, 3)[2], *joints, self._last_action, command])

    def step(self, command: np.ndarray) -> None:
        """Make a control step."""
        obs = torch.tensor(self.observation(command)[None], dtype=torch.float32)
        with torch.inference_mode():
            self._last_action = self._policy(TensorDict({"actor": obs}, batch_size=[1]))[0].numpy()
        targets = self._scale * self._last_action + self._offset
        self.data.ctrl[:] = targets[self._order]
        for _ in range(self._decimation):
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)  # sensors of the state after the step


def main() -> None:
    """Train, time ``env.step``, and evaluate checkpoints until one tracks enough."""
    args = measure.parse_args()
    configure_torch_backends()
    cfg, agent = load_env_cfg(TASK), asdict(load_rl_cfg(TASK))
    cfg.scene.num_envs, cfg.seed = args.num_envs, args.seed
    if args.settings == "equal":
        for name, value in measure.EQUAL.items():
            setattr(cfg.sim.mujoco, name, value)
    agent |= {"seed": args.seed, "save_interval": measure.INTERVAL, "logger": "tensorboard", "upload_model": False}
    agent["num_steps_per_env"] = measure.NUM_STEPS
    agent["algorithm"] |= {"num_learning_epochs": measure.EPOCHS, "num_mini_batches": measure.MINIBATCHES}
    for network in ("actor", "critic"):
        agent[network]["hidden_dims"] = measure.NETWORKS
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg=cfg, device=args.device))
    folder = args.out.parent / "mjlab"
    folder.mkdir(exist_ok=True)
    runner = MjlabOnPolicyRunner(env, agent, str(folder), args.device)
    recorder = measure.Recorder(runner, args.started)
    runner.learn(args.iterations, init_at_random_ep_len=True)
    actions = 0.5 * torch.randn(args.num_envs, env.num_actions, device=args.device)
    synchronize = torch.cuda.synchronize if "cuda" in args.device else lambda: None
    step = measure.step_ms(lambda: env.step(actions), synchronize)
    settings = [f"{name}={getattr(cfg.sim.mujoco, name)}" for name in ("timestep", *measure.EQUAL)]
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    result = {"settings": settings, "versions": versions, "step_ms": step}
    result |= recorder.summary(args.num_envs)
    policies = walkers(env.unwrapped, runner, folder)
    write_json(args.out, result | measure.time_until_enough(recorder, policies, args.num_envs))


def walkers(env: ManagerBasedRlEnv, runner: Any, folder: Path) -> Iterator[tuple[int, Go1]]:
    """Yield the policies of a run in order; model_10.pt was saved after iteration 11."""
    numbers = sorted(int(file.stem.removeprefix("model_")) for file in folder.glob("model_*.pt"))
    for number in filter(None, numbers):
        actor = runner.get_inference_policy("cpu")
        weights = torch.load(folder / f"model_{number}.pt", map_location="cpu", weights_only=True)["actor_state_dict"]
        with torch.inference_mode():  # as its statistics of observations were made
            actor.load_state_dict(weights)
        yield number + 1, Go1(env, actor)


if __name__ == "__main__":
    main()
