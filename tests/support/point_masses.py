"""A small task with just what the trainer needs, and trainers in it."""

import torch
from rsl_rl.utils.logger import Logger
from tensordict import TensorDict

from legged_torque.learning.trainer import Trainer


class PointMasses:
    """Points on a line that are to be at 0; just what the trainer needs of a task."""

    num_actions, device, dt, max_episode_length, num_processes = 1, "cpu", 0.1, 20, 1
    keep_final_observations = False

    def __init__(self, num_envs=8):
        self.num_envs, self.log, self.health = num_envs, self, self
        self.x, self.length = 2.0 * torch.rand(num_envs) - 1.0, torch.zeros(num_envs, dtype=torch.long)
        self.total_steps, self.distance = torch.zeros((), dtype=torch.long), 0.0
        self.episode_length_buf = self.length

    def get_observations(self):
        return TensorDict({"policy": self.x[:, None].clone()}, [self.num_envs])

    def step(self, actions):
        self.x += 0.2 * actions[:, 0]
        self.length += 1
        self.total_steps += self.num_envs * self.num_processes
        rewards = 2.5 - self.x.square()  # more than 0: an early end is no gain
        self.distance = float(self.x.abs().mean())
        far, time_outs = self.x.abs() > 1.5, self.length >= self.max_episode_length
        extras = {"time_outs": time_outs & ~far}
        if self.keep_final_observations:
            extras["final_observations"] = self.get_observations()
        dones = far | time_outs
        self.x = torch.where(dones, 2.0 * torch.rand(self.num_envs) - 1.0, self.x)
        self.length.masked_fill_(dones, 0)
        return self.get_observations(), rewards, dones, extras

    def read(self, max_episode_length_s=None):
        """Both the log and the health."""
        return (0.0, {}) if max_episode_length_s is None else {"Task/distance": self.distance}

    def curriculum_values(self):
        return {}

    def check_buffers(self):
        return None

    compile = update_curriculum = check_buffers

    def state_dict(self):
        return {"total_steps": self.total_steps.clone()}

    def load_state_dict(self, state):
        self.total_steps.copy_(state["total_steps"])

    def identity(self):
        return {"settings": {"num_envs": self.num_envs}}

    def world_state_dict(self):
        return {"x": self.x, "length": self.length}

    def load_world_state_dict(self, state):
        self.x.copy_(state["x"])
        self.length.copy_(state["length"])


def make_trainer(learner, folder=None, task=None, **settings):
    """A trainer of a learner in point masses, with nothing but what it needs."""
    task = task or PointMasses()
    evaluation = {"interval": 0, "also": [], "perturbation": "", "num_envs": 1, "num_samples": 1}
    cfg = {"num_steps_per_env": 8, "save_interval": 100, "capture": True, "seed": 0, "evaluation": evaluation}
    cfg |= {"algorithm": {}, "logger": {"class_name": "legged_torque.learning.training_log:NoLogWriter"}, **settings}
    logger = Logger(str(folder) if folder else None, cfg, {}, task.num_envs, False, 1, 0, "cpu")
    return Trainer(task, learner.construct_algorithm(task.get_observations(), task, cfg, "cpu"), cfg, logger)


def assert_holds_points(trainer, within=0.15):
    """After a training its policy drives every point to 0, from which it was anywhere before."""
    trainer.learn(60, init_at_random_ep_len=True)
    x = torch.linspace(-1.0, 1.0, 9)[:, None]
    with torch.no_grad():
        for _ in range(15):
            x = x + 0.2 * trainer.alg.policy()({"policy": x})
    assert float(x.abs().max()) < within
