"""Exported policies that remember give what torch gives, step by step and from episode to episode."""

import numpy as np
import pytest
import torch
from support.exports import TRAINING, XML, export_policy

from legged_torque.deploy.policy import Policy
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.deploy.simulation import Simulation
from legged_torque.envs import task_registry
from legged_torque.utils.errors import UserError


class Recorded(Policy):
    """Keeps observations and actions, a list per episode."""

    def reset(self):
        super().reset()
        self.episodes = [*getattr(self, "episodes", []), []]

    def act(self, obs):
        self.episodes[-1].append((obs, super().act(obs)))
        return self.episodes[-1][-1][1]


@pytest.mark.parametrize(("rnn_type", "layers"), [("gru", 1), ("lstm", 2)])
def test_a_thousand_steps_in_plain_mujoco(make_task, tmp_path, rnn_type, layers):
    """The network is torch's to 1e-5 through all episodes, and starts each of them with nothing."""
    task = make_task("a1_torque", num_envs=3)
    env_cfg, train_cfg = task_registry.get_cfgs("a1_torque")
    train_cfg.use_preset("student", env_cfg)
    student = train_cfg.distillation.student
    student.rnn_type, student.rnn_num_layers, student.rnn_hidden_dim, student.hidden_dims = rnn_type, layers, 32, [16]
    torch.manual_seed(3)
    model = task_registry.make_alg_runner(task, "a1_torque", train_cfg=train_cfg, log_root=None)[0].alg.policy().eval()
    difference, unsupported = export_policy(task, model, tmp_path / "out", "a1_torque", TRAINING)
    assert difference < 1e-5 and not unsupported
    policy = Recorded(tmp_path / "out")
    assert [each["input"] for each in policy.description["network"]["memory"]] == ["h_in", "c_in"][: 1 + (layers > 1)]
    Simulation(policy, MujocoRobot(XML, policy.description)).run(1000, 1)
    episodes = [episode for episode in policy.episodes if episode]
    assert sum(map(len, episodes)) == 1000 and len(episodes) > 1
    for episode in episodes:
        obs, actions = (torch.from_numpy(np.stack(part)) for part in zip(*episode, strict=True))
        with torch.inference_mode():
            expected = model.mlp(model.rnn.rnn(obs)[0])
        torch.testing.assert_close(actions, expected, rtol=1e-5, atol=1e-5)
    text = (tmp_path / "out" / "policy.yaml").read_text()
    assert "size: 32" in text
    (tmp_path / "out" / "policy.yaml").write_text(text.replace("size: 32", "size: 16"))
    with pytest.raises(UserError, match="has the input and output"):
        Policy(tmp_path / "out")
