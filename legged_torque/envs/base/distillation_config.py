"""Settings of students, with names of rsl_rl's Distillation and PPO."""

from typing import Annotated, Any, Literal

from legged_torque.utils.config import Section
from legged_torque.utils.limits import Activation, Count, Fraction, Limits, Positive, Share, Sizes

DISTILLATION = "legged_torque.learning.distillation:Distillation"


class DistillationCfg(Section):
    """The section ``distillation``; a student reads no others but ``obs_groups.actor``, of which it sees the groups."""

    teachers: list[str] = []  # runs, or checkpoints of theirs, whose policies act as they would; of the same task
    learning_rate: Fraction = 2e-3  # of Adam
    annealing_start: Share = 0.5  # share of the training after which the learning rate falls to 0
    num_learning_epochs: Annotated[int, Limits(1, 1e4)] = 4  # times that each rollout is learned from
    num_mini_batches: Annotated[int, Limits(1, 1e6)] = 8  # equal parts of the worlds; an epoch leaves out the rest
    gradient_length: Count = 12  # control steps of a gradient step, through which it goes back in time
    max_grad_norm: Positive = 1.0  # gradients are clipped to this norm
    loss_type: Literal["mse", "huber"] = "mse"  # of actions that differ from the teacher's

    class student:  # its network
        rnn_type: Literal["gru", "lstm", "none"] = "gru"  # what remembers; none: rsl_rl's MLPModel
        rnn_hidden_dim: Annotated[int, Limits(1, 1e6)] = 256  # numbers that each layer remembers
        rnn_num_layers: Annotated[int, Limits(1, 100)] = 1  # layers that remember
        hidden_dims: Sizes = [512, 256]  # sizes of the hidden layers after them
        activation: Activation = "elu"  # after every hidden layer
        init_std: Positive = 0.1  # standard deviation of actions while it learns


def preset() -> dict[str, dict[str, Any]]:
    """Return the changes that choose a student."""
    runner = {"num_steps_per_env": 24, "total_steps": 120_000_000}
    return {"runner": runner, "algorithm": {"class_name": DISTILLATION}}
