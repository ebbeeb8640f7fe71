"""Equivariant networks: the mirror image of what they read gives the mirror image of what they return.

Hidden units are mirror images of each other, too: the first of the last, and so on. The weights of each layer are then
their own mirror images, and stay so while their gradients are. Such networks learn from a sample what they would learn
from it and its mirror image (compared for legged robots in arXiv 2403.17320).
"""

from collections.abc import Mapping, Sequence
from itertools import accumulate

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
from torch import Tensor, nn

from legged_torque.learning.distribution import GaussianDistribution
from legged_torque.learning.multi_head import MultiHeadMLP, MultiHeadModel
from legged_torque.utils.errors import UserError

Map = tuple[Tensor, Tensor]
"""Order and signs of a mirror image: entry i becomes sign i times entry order i."""


class MirroredWeights:
    """The mirror image of all parameters of actor and critic, one behind the other.

    Attributes:
        order: Of which parameter each one is the mirror image. Shape: (parameters,), int64.
        signs: 1 or -1, the factor on it. Shape: (parameters,).
    """

    def __init__(self, actor: MLPModel, critic: MLPModel, maps: Mapping[str, Map]) -> None:
        """Take the mirror images of groups of observations and of "actions", as a task's ``mirror.maps``.

        A UserError if that of a position is a torque of a multi-head actor, whose weights then have none.
        """
        actions, parts = maps["actions"], list[Map]()
        for model, outputs in ((actor, actions), (critic, _kept(1, actions))):
            inputs = _joined([maps[group] for group in model.obs_groups])
            parts += _model_maps(model, inputs, outputs)
        self.order, self.signs = _joined(parts)

    def averaged(self, values: Tensor) -> Tensor:
        """Return the mean of numbers, one per parameter, and of their mirror image."""
        return torch.addcmul(values, values.index_select(0, self.order), self.signs).mul_(0.5)

    def is_symmetric(self, values: Tensor) -> bool:
        """Return whether numbers are their own mirror image, up to rounding."""
        return torch.allclose(self.averaged(values), values, atol=1e-3, equal_nan=True)

    def symmetric(self, values: Tensor) -> Tensor:
        """Return numbers of which one half is kept, and the other half becomes its mirror image."""
        places = torch.arange(len(self.order), device=self.order.device)
        signs = torch.where(self.order < places, self.signs, 1.0)
        signs = torch.where((self.order == places) & (self.signs < 0.0), 0.0, signs)
        return values.index_select(0, torch.minimum(self.order, places)) * signs


def are_known(actor: MLPModel, critic: MLPModel) -> bool:
    """Return whether all parameters of actor and critic are known and learn; those of a user's classes are not."""
    models = (actor, critic)
    return (
        all(type(model) in (MLPModel, MultiHeadModel) and type(model.mlp) in (MLP, MultiHeadMLP) for model in models)
        and type(actor.distribution) is GaussianDistribution
        and not any(model.obs_normalization for model in models)
        and all(parameter.requires_grad for model in models for parameter in model.parameters())
    )


def _model_maps(model: MLPModel, inputs: Map, outputs: Map) -> list[Map]:
    """Return the mirror images of a model's parameters, in their order."""
    network = model.mlp
    if isinstance(network, MultiHeadMLP):
        size = len(outputs[0]) // 2
        if bool((outputs[0][:size] >= size).any()):
            raise UserError("the mirror images of positions are torques")
        positions = outputs[0][:size], outputs[1][:size]
        torques = outputs[0][size:] - size, outputs[1][size:]
        features = _reversed(network.position_head[0].in_features, outputs)
        known = _layer_maps(network.trunk, inputs, features)
        known |= _layer_maps(network.position_head, features, positions)
        known |= _layer_maps(network.torque_head, _joined([features, positions]), torques)
    else:
        known = _layer_maps(network, inputs, outputs)
    deviations = outputs[0], torch.ones_like(outputs[1])
    return [known.get(parameter, deviations) for parameter in model.parameters()]


def _layer_maps(network: MLP, inputs: Map, outputs: Map) -> dict[Tensor, Map]:
    """Return the mirror images of the weights and biases of all layers."""
    maps: dict[Tensor, Map] = {}
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    for layer in layers:
        after = outputs if layer is layers[-1] else _reversed(layer.out_features, outputs)
        order = after[0].unsqueeze(1) * layer.in_features + inputs[0]
        maps[layer.weight] = order.flatten(), (after[1].unsqueeze(1) * inputs[1]).flatten()
        maps[layer.bias] = inputs = after
    return maps


def _kept(size: int, like: Map) -> Map:
    """Return a mirror image that changes nothing."""
    return torch.arange(size, device=like[0].device), like[1].new_ones(size)


def _reversed(size: int, like: Map) -> Map:
    """Return the mirror image of hidden units."""
    order, signs = _kept(size, like)
    return order.flip(0), signs


def _joined(maps: Sequence[Map]) -> Map:
    """Return the mirror image of several vectors one behind the other."""
    starts = accumulate((len(order) for order, _ in maps), initial=0)
    orders = [order + start for (order, _), start in zip(maps, starts, strict=False)]
    return torch.cat(orders), torch.cat([signs for _, signs in maps])
