"""FLOP and bytes of update and physics: as PyTorch counts them, and as counted by hand."""

import pytest
from torch.utils.flop_counter import FlopCounterMode

from legged_torque.envs import task_registry
from legged_torque.learning.ppo import cpu_ppo
from legged_torque.utils.config import set_by_path
from legged_torque.utils.options import Options
from tools import roofline

SMALL = {
    "runner.num_steps_per_env": 3,
    "runner.capture": False,
    "algorithm.num_learning_epochs": 2,
    "algorithm.num_mini_batches": 2,
    "actor.hidden_dims": [8, 6],
    "critic.hidden_dims": [7, 5],
}


def make_runner(tmp_path, task="a1_position", **changes):
    """A runner with small networks and two worlds that has collected a rollout."""
    env_cfg, train_cfg = task_registry.get_cfgs(task, Options(device="cpu", num_envs=2))
    for path, value in {**SMALL, **changes}.items():
        set_by_path(train_cfg, path, value)
    env = task_registry.get_task_class(task)(env_cfg, "cpu")
    runner, _ = task_registry.make_alg_runner(env, train_cfg=train_cfg, log_root=tmp_path)
    runner.alg.train_mode()
    runner.collect_rollout()
    return runner


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        ("a1_position", {}),
        ("a1_torque_multihead", {"actor.head_hidden_dims": [4], "algorithm.symmetry_cfg.use_mirror_loss": True}),
    ],
)
def test_flop_as_pytorch_counts_them(monkeypatch, tmp_path, task, changes):
    """The matrix products of a real update, forward and backward, with mirror images and a multi-head actor."""
    alg = make_runner(tmp_path, task, **changes).alg
    monkeypatch.setattr(cpu_ppo, "USE_ONEDNN", False)  # whose products it does not count
    with FlopCounterMode(display=False) as counter:
        alg.update()
    assert roofline.update_flop(alg) == counter.get_total_flops() > 0
