"""CUDA graphs change nothing, and the update's kernels learn as autograd does: a training on a plane."""

import pytest
import torch
from support.on_device import differences, gradient_errors, recorded

from legged_torque.utils.task_registry import set_seed

WORDS = ["--task=a1_torque_multihead", "--num_envs=512", "--perturbation=low", "--set=runner.num_steps_per_env=8"]
WORDS += ["--set=algorithm.num_mini_batches=2", "--set=algorithm.num_learning_epochs=2", "--set=evaluation.interval=0"]
WORDS += [
    f"--set={way}.delay.{time}" for way in ("motors", "sensing") for time in ("range=[0, 3]", "jitter=2", "loss=0.1")
]


@pytest.fixture(scope="module")
def trained(device):
    """What differs between four iterations with and without graphs, and the runners."""
    return differences(device, 4, *WORDS)


def test_graphs_change_nothing(trained):
    """Observations, actions, rewards, returns, networks and losses are the same bits."""
    assert trained[0] == {}


def test_graphs_after_loading(trained, tmp_path):
    """A runner that replays graphs and loads a checkpoint goes on as one that has neither."""
    plain, captured = trained[1]
    captured.save(str(tmp_path / "model.pt"))
    captured.load(str(tmp_path / "model.pt"))
    results = []
    for runner in (plain, captured):
        set_seed(7)
        runner.learn(3)
        results.append(recorded(runner))
    assert [name for name, value in results[0].items() if not torch.equal(value, results[1][name])] == []


def test_gradients_of_a_training(trained):
    """In bfloat16, from a real rollout, for the networks of the task; unclipped, since rounding decides at limits."""
    alg = trained[1][1].alg
    if not hasattr(alg, "gradients"):
        pytest.skip("needs a GPU")
    alg.clip_param = 10.0
    errors = gradient_errors(alg)
    assert max(errors.values()) < 0.1, errors
