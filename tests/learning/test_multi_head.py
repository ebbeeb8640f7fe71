"""The multi-head actor: its architecture counted by hand, its output and its gradients."""

from functools import partial

import numpy as np
import pytest
import torch
from support.settings import build_runner, error_of
from tensordict import TensorDict

from legged_torque.learning.multi_head import MultiHeadMLP, MultiHeadModel

NUM_DOF = 12
NUM_ACTIONS = 2 * NUM_DOF
NUM_OBS = 3 + 3 + 3 + NUM_DOF + NUM_DOF + NUM_ACTIONS
"""Gravity, angular velocity, command, joint positions, joint velocities, last action."""

SHAPES = {
    "trunk": [(512, NUM_OBS), (256, 512)],
    "position_head": [(128, 256), (12, 128)],
    "torque_head": [(128, 268), (12, 128)],
}
"""Weights of every linear layer as (outputs, inputs), in order."""


@pytest.fixture(scope="module")
def make_runner(make_task):
    """Factory of runners of small tasks, with weights that depend on the seed."""
    return partial(build_runner, make_task, num_envs=2)


def make_model(num_actions=6, **sizes):
    """A model for observations of five numbers."""
    obs = TensorDict({"policy": torch.zeros(1, 5)}, [1])
    return MultiHeadModel(obs, {"actor": ["policy"]}, "actor", num_actions, **sizes)


def dense(x, weights, name, last_activation):
    """Linear layers with ELU between them, in numpy."""
    layers = [key.removesuffix(".weight") for key in weights if key.startswith(f"mlp.{name}.") and "weight" in key]
    for layer in layers:
        x = x @ weights[f"{layer}.weight"].T + weights[f"{layer}.bias"]
        if layer != layers[-1] or last_activation:
            x = np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))
    return x


def forward_by_hand(actor, obs):
    """Figure 2 of the paper in double precision: positions from the trunk, torques from the trunk and positions."""
    weights = {key: value.double().numpy() for key, value in actor.state_dict().items()}
    features = dense(obs["policy"].double().numpy(), weights, "trunk", last_activation=True)
    positions = dense(features, weights, "position_head", last_activation=False)
    torques = dense(np.concatenate([features, positions], axis=1), weights, "torque_head", last_activation=False)
    return np.concatenate([positions, torques], axis=1)


@pytest.mark.parametrize("name", ["a1_torque_multihead", "a1_multihead"])
def test_layers_of_the_paper(make_runner, name):
    """Trunk 512-256, heads of 128, the torque head on 256 + 12 inputs; every parameter is accounted for."""
    runner = make_runner(name=name)
    state = runner.alg.get_policy().state_dict()
    for part, shapes in SHAPES.items():
        weights = [tuple(v.shape) for k, v in state.items() if k.startswith(f"mlp.{part}.") and k.endswith("weight")]
        assert weights == shapes
    counted = sum(rows * columns + rows for shapes in SHAPES.values() for rows, columns in shapes)
    assert sum(value.numel() for value in state.values()) == counted + NUM_ACTIONS  # and a deviation per action
    critic = [tuple(v.shape) for k, v in runner.alg.critic.state_dict().items() if k.endswith("weight")]
    assert [rows for rows, _ in critic] == [512, 256, 128, 1]
    assert [columns for _, columns in critic[1:]] == [512, 256, 128]


@pytest.mark.parametrize(("name", "end"), [("a1_torque_multihead", 0.0), ("a1_multihead", 0.1)])
def test_weights_in_the_entropy(make_runner, name, end):
    """Those of eq. 7: positions count less and less while their part fades within 50 million steps, torques wholly."""
    runner = make_runner(name=name)
    for steps, weight in ((0, 1.0), (32_000_000, 1.0 - 0.64 * (1.0 - end)), (50_048_000, end)):
        runner.env.total_steps.fill_(steps)
        runner.env.update_curriculum()
        runner.alg.set_progress(0, 1)
        expected = torch.tensor([weight] * NUM_DOF + [1.0] * NUM_DOF)
        torch.testing.assert_close(runner.alg.actor.distribution.weights, expected)


@pytest.mark.parametrize("name", ["a1_position", "a1_torque", "a1_torque_curriculum"])
def test_the_other_approaches_have_one_head(make_runner, name):
    """Their actor is 512-256-128-12, the same for all of them."""
    state = make_runner(name=name).alg.get_policy().state_dict()
    shapes = [tuple(value.shape) for key, value in state.items() if key.endswith("weight")]
    assert shapes == [(512, NUM_OBS - NUM_DOF), (256, 512), (128, 256), (12, 128)]


def test_output_by_hand():
    """Layers of other sizes and numbers fit together; positions come first, nothing follows the last layers."""
    model = make_model(hidden_dims=[8, 7, 6], head_hidden_dims=[5, 4])
    shapes = {key: tuple(value.shape) for key, value in model.state_dict().items() if key.endswith("weight")}
    assert list(shapes.values()) == [(8, 5), (7, 8), (6, 7), (5, 6), (4, 5), (3, 4), (5, 9), (4, 5), (3, 4)]
    obs = TensorDict({"policy": torch.randn(3, 5)}, [3])
    np.testing.assert_allclose(model(obs).detach(), forward_by_hand(model, obs), rtol=1e-4, atol=1e-6)


def test_gradient_paths():
    """Torques teach all layers, the position head included; positions teach everything but the torque head."""
    torch.manual_seed(0)
    network = MultiHeadMLP(NUM_OBS, NUM_ACTIONS, [32, 16], [8], "elu")
    positions, torques = network(torch.randn(8, NUM_OBS)).square().sum(dim=0).split(NUM_DOF)
    parameters = dict(network.named_parameters())
    for loss, learned in (
        (torques.sum(), set(parameters)),
        (positions.sum(), {n for n in parameters if "torque" not in n}),
    ):
        gradients = torch.autograd.grad(loss, list(parameters.values()), retain_graph=True, allow_unused=True)
        moved = {name for name, g in zip(parameters, gradients, strict=True) if g is not None and g.abs().max() > 1e-4}
        assert moved == learned


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"num_actions": 5}, "a multi-head actor needs an even number of actions, env.num_actions is 5"),
        ({"hidden_dims": [8]}, "needs two actor.hidden_dims or more"),
        ({"head_hidden_dims": []}, "one of actor.head_hidden_dims"),
    ],
)
def test_sizes_that_make_no_sense(sizes, message):
    """An odd number of actions or a missing layer is refused by name."""
    assert message in error_of(make_model, **sizes)
