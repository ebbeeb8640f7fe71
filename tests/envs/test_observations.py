"""Observations of policy and critic."""

import math

import numpy as np
import pytest
import torch
from support.control import FEET, IN_THE_AIR, NOMINAL, random_state


@pytest.mark.parametrize(("name", "num_actions"), [("a1_position", 12), ("a1_torque", 12), ("a1_multihead", 24)])
def test_observation_layout(make_task, name, num_actions):
    """Both observation groups, number by number, of a constructed state."""
    task = make_task(name, 2)
    q, qd, action = random_state(task, seed=3)
    angle = 2 * math.pi / 3  # about the diagonal: body x, y, z are world y, z, x
    half = math.sin(angle / 2) / math.sqrt(3)
    task.base_quat.copy_(torch.tensor([math.cos(angle / 2), half, half, half]).expand(2, 4))
    task.base_pos.copy_(torch.tensor([5.0, 6.0, 0.35]).expand(2, 3))
    task.sim.qvel[:, :3] = torch.tensor([0.1, 0.2, 0.3])
    task.sim.qvel[:, 3:6] = torch.tensor([1.0, -2.0, 4.0])
    task.commands.copy_(torch.tensor([[0.5, -0.25, 1.0], [-1.0, 0.75, -0.5]]))
    task.actions.copy_(torch.tensor(action))
    task.sim.contact_found.zero_()
    task.sim.contact_found[:, [0, 1, 2, FEET[0], FEET[3]]] = torch.tensor([1.0, 1.0, 2.0, 1.0, 1.0])
    task.state.update()
    assert task.contacts[0].nonzero().flatten().tolist() == [0, 1, 2, FEET[0], FEET[3]] and task.contacts.max() == 1
    task.compute_observations()
    obs = task.get_observations()
    assert obs["policy"].shape == (2, 33 + num_actions) and obs["critic"].shape == (2, 158 + num_actions)
    for world, commands in enumerate(([1.0, -0.5, 0.25], [-2.0, 1.5, -0.125])):
        policy = [0.0, -1.0, 0.0, 0.25, -0.5, 1.0, *commands]
        policy += [*(q[world] - NOMINAL), *(0.05 * qd[world]), *action[world]]
        critic = [0.4, 0.6, 0.2, 0.35, 1.0, 0.0, 0.0, 1.0]
        np.testing.assert_allclose(obs["policy"][world], policy, atol=2e-6)
        np.testing.assert_allclose(obs["critic"][world, :-117], policy + critic, atol=2e-6)


def test_history(make_task):
    """The policy sees the steps before as it saw them then, the newest first; an episode starts with copies."""
    task = make_task("a1_torque", 3, **{"env.history_length": 3, "noise.add_noise": True, "env.episode_length_s": 0.08})
    task.base_pos[:, 2] = 5.0
    task.episode_length_buf = torch.tensor([0, 0, 1])
    first = task.get_observations()
    assert first["policy"].shape == (3, 135) and first["critic"].shape == (3, 170)
    torch.testing.assert_close(first["policy"], first["policy"][:, :45].repeat(1, 3))
    seen = [first["policy"][:, :45]]
    for _ in range(3):
        policy = task.step(torch.randn(3, 12))[0]["policy"]
        seen.append(policy[:, :45])
    assert torch.equal(policy[:2], torch.cat(seen[:0:-1], dim=1)[:2])
    assert torch.equal(policy[2], seen[-1][2].repeat(3)) and task.reset_buf.tolist() == [False, False, True]


def test_observation_scales(make_task):
    """Every scale is a setting that acts on its own entries alone."""
    scales = {"lin_vel": 3.0, "ang_vel": 5.0, "dof_pos": 7.0, "dof_vel": 11.0}
    task = make_task("a1_torque", 1, **{f"normalization.obs_scales.{key}": value for key, value in scales.items()})
    task.base_quat.copy_(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
    task.sim.qvel.fill_(0.5)
    task.commands.fill_(0.25)
    task.dof_pos.copy_(task.default_dof_pos.unsqueeze(0) + 0.1)
    task.state.update()
    task.compute_observations()
    policy = [0, 0, -1, *[2.5] * 3, 0.75, 0.75, 1.25, *[0.7] * 12, *[5.5] * 12, *[0] * 12]
    np.testing.assert_allclose(task.get_observations()["policy"][0], policy, atol=1e-5)
    np.testing.assert_allclose(task.get_observations()["critic"][0, 45:48], [1.5] * 3, atol=1e-5)


def test_observations_are_clipped_and_copied(make_task):
    """Observations stay within +-100, and the next step does not change those that were returned."""
    task = make_task("a1_torque", 1, **IN_THE_AIR)
    task.dof_vel.copy_(torch.tensor([[5000.0, -5000.0] * 6]))
    task.compute_observations()
    for group in ("policy", "critic"):
        np.testing.assert_array_equal(task.get_observations()[group][0, 21:33], [100.0, -100.0] * 6)
    task.dof_vel.zero_()
    first, *_ = task.step(torch.ones(1, 12))
    kept = first.clone()
    second, *_ = task.step(-torch.ones(1, 12))
    assert torch.equal(first["critic"], kept["critic"]) and not torch.equal(first["critic"], second["critic"])
