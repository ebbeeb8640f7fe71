"""Live sessions of policies that have not been trained, and tilted trunks."""

import contextlib
import threading

import mujoco
import numpy as np
import torch
from support.ground import ground_cfg

from legged_torque.envs import task_registry
from legged_torque.utils.config import set_by_path
from legged_torque.utils.options import Options
from legged_torque.utils.runs import checkpoint_file
from legged_torque.utils.task_registry import LoadedRun
from legged_torque.viewer.session import Session


def new_session(folder, name, num_envs=2, ground=None, steps=(0,), clock=None, **settings):
    """A session of a new run in a folder, which may be missing, with the last of its checkpoints of random weights.

    ``ground`` are settings of a small rough map, ``steps`` those of training before each checkpoint, numbered from 0
    on; ``clock`` takes the place of the real one, and ``settings`` go by dotted paths.
    """
    env_cfg, train_cfg = task_registry.get_cfgs(name, Options(perturbation="none"))
    if ground:
        ground_cfg(env_cfg, **ground)
    for path, value in {"env.num_envs": num_envs, **settings}.items():
        set_by_path(env_cfg, path, value)
    torch.manual_seed(1)
    folder.mkdir(exist_ok=True)
    env = task_registry.make_env(name, Options(device="cpu"), env_cfg)[0]
    runner = task_registry.make_alg_runner(env, name, log_root=None)[0]
    for number, count in enumerate(steps):
        with torch.no_grad():
            for parameter in runner.alg.actor.parameters():
                parameter.normal_(0.0, 0.02)
        env.total_steps.fill_(count)
        runner.current_learning_iteration, runner.logger.tot_timesteps = number, count
        runner.save(str(checkpoint_file(folder, number)))
    run = LoadedRun(folder, {"task": name}, env_cfg, train_cfg, checkpoint_file(folder, number))
    times = {"clock": clock, "sleep": clock.sleep} if clock else {}
    return Session(task_registry.get_task_class(name), run, "cpu", **times)


@contextlib.contextmanager
def running(session):
    """Run a session in a thread, paused."""
    session.set_paused(True)
    thread = threading.Thread(target=session.run, daemon=True)
    thread.start()
    yield session
    session.stop()
    thread.join(timeout=120)


def tilted(yaw, angle=1.0):
    """The quaternion of a trunk that is turned about the vertical, then tilted about a horizontal axis [rad]."""
    turn, tilt, result = np.zeros(4), np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, [0.0, 0.0, 1.0], yaw)
    mujoco.mju_axisAngle2Quat(tilt, [0.6, 0.8, 0.0], angle)
    mujoco.mju_mulQuat(result, tilt, turn)
    return result
