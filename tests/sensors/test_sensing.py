"""Joint encoders and IMU that are late: the policy sees what has arrived, the critic the present."""

import numpy as np
import pytest
import torch
from support.control import NOMINAL
from support.episodes import HIGH_UP, time_out
from support.settings import error_of, torques_in_torch


def policy_of(qpos, qvel, action):
    """What a policy sees of measurements: gravity, angular velocity, command, joints, last action."""
    w, x, y, z = qpos[:, 3:7].T
    gravity = -np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    parts = [gravity, 0.25 * qvel[:, 3:6], np.zeros((len(w), 3)), qpos[:, 7:] - NOMINAL, 0.05 * qvel[:, 6:], action]
    return np.concatenate(parts, axis=1)


@pytest.mark.parametrize("in_torch", [False, True], ids=["kernel", "torch"])
@pytest.mark.parametrize(("delay", "decimation"), [(0, 4), (2, 4), (5, 2)])
def test_physics_steps(make_task, in_torch, delay, decimation):
    """The policy sees the state of some physics steps ago, at most that of the episode's start; the critic the present.

    World 0 starts anew; it may not see what was before.
    """
    changes = {"sensing.delay.range": [delay, delay], "sensing.delay.jitter": 0, "control.decimation": decimation}
    changes |= {"sensing.delay.loss": 1e-9}  # so that there is a queue without delay, too
    task = make_task("a1_torque", 3, **HIGH_UP, **changes, **{"domain_rand.init_ang_vel": [-2, 2]})
    if in_torch:
        torques_in_torch(task)
    task.commands.zero_()
    task.command_generator.values.zero_()
    now = lambda: (task.sim.qpos.numpy().copy(), task.sim.qvel.numpy().copy())  # noqa: E731
    history, launch = [now()], task.sim._launch
    task.sim._launch = lambda *args: (launch(*args), history.append(now()))
    start = np.zeros(3, int)
    for step in range(6):
        if step == 3:
            time_out(task, [0])
        action = torch.randn(3, 12)
        obs, _, dones, _ = task.step(action)
        if dones[0]:
            start[0], history[-1] = len(history) - 1, now()
            action[0] = 0.0
        at = np.maximum(len(history) - 1 - delay, start)
        seen, present = (
            [np.stack([history[t][i][w] for w, t in enumerate(ts)]) for i in (0, 1)] for ts in (at, at * 0 - 1)
        )
        seen, present = policy_of(*seen, action.numpy()), policy_of(*present, action.numpy())
        own = [*range(6), *range(9, 45)]  # without commands
        np.testing.assert_allclose(obs["policy"].numpy()[:, own], seen[:, own], atol=1e-5)
        np.testing.assert_allclose(obs["critic"].numpy()[:, own], present[:, own], atol=1e-5)
        assert delay == 0 or np.abs(seen - present)[1:].max() > 1e-3
    assert start[0] > 0


def test_jitter_and_loss(make_task):
    """Time goes on for the policy but never back; each world has a delay of its own; lost measurements are held."""
    changes = {"sensing.delay.range": [0, 3], "sensing.delay.jitter": 3, "sensing.delay.loss": 0.3}
    task = make_task("a1_torque", 500, **HIGH_UP, **changes, **{"control.decimation": 1})
    queue, clock = task.sensors.sensing.queue, torch.zeros(500)
    assert sorted(set(queue.drawn.floor()[:, 0].tolist())) == [0.0, 1.0, 2.0, 3.0]
    send, seen = queue.send, []
    queue.send = lambda packet, stream: send(torch.full_like(packet, len(seen) + 1.0), stream)
    for step in range(1, 40):
        task.step(torch.zeros(500, 12))
        arrived = task.sensors.sensing.dof_vel[:, 0].clone()
        assert (arrived >= clock).all() and (arrived <= step).all()
        clock = arrived
        seen.append(step - arrived)
    ages = torch.stack(seen[10:]).mean(dim=0)
    by_delay = [ages[queue.drawn.floor()[:, 0] == delay].mean() for delay in range(4)]
    np.testing.assert_allclose(np.diff(by_delay), 1.0, atol=0.1)  # a step of constant delay is a step of age
    assert error_of(make_task, "a1_torque", 1, **{"sensing.delay.range": [2, 1]}).startswith("sensing.delay.range")
