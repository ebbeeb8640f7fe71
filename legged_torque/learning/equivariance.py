"""Equivariant networks: the mirror image of what they read gives the mirror image of what they return.

Hidden units are mirror images of each other, too: the first of the last, and so on. The weights of each layer are then
their own mirror images, and stay so while their gradients are. Such networks learn from a sample what they would learn
from it and its mirror image (compared for legged robots in arXiv 2403.17320).
"""

from collections.abc import Mapping, Sequence
from itertools import accumulate

import torch
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules import MLP
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from legged_torque.learning.distribution import GaussianDistribution
from legged_torque.learning.multi_head import MultiHeadMLP, MultiHeadModel
from legged_torque.utils.errors import UserError

Map = tuple[Tensor, Tensor]
"""Order and signs of a mirror image: entry i becomes sign i times entry order i."""


class MirroredWeights:
    """The mirror image of all parameters of some models, one behind the other.

    Attributes:
        order: Of which parameter each one is the mirror image. Shape: (parameters,), int64.
        signs: 1 or -1, the factor on it. Shape: (parameters,).
    """

    def __init__(self, maps: Mapping[str, Map], actor: MLPModel, critic: MLPModel | None = None) -> None:
        """Take the mirror images of groups of observations and of "actions", as a task's ``mirror.maps``, and models.

        A UserError if that of a position is a torque of a multi-head actor, whose weights then have none.
        """
        actions, parts, models = maps["actions"], list[Map](), [actor] if critic is None else [actor, critic]
        for model in models:
            inputs = _joined([maps[group] for group in model.obs_groups])
            parts += _model_maps(model, inputs, actions if model is actor else _kept(1, actions))
        self.order, self.signs = _joined(parts)
        self._parameters = [parameter for model in models for parameter in model.parameters()]

    def averaged(self, values: Tensor) -> Tensor:
        """Return the mean of numbers, one per parameter, and of their mirror image."""
        return torch.addcmul(values, values.index_select(0, self.order), self.signs).mul_(0.5)

    def average_gradients(self) -> None:
        """Replace the gradient of each parameter by its mean with that of its mirror image."""
        gradients = [torch.zeros_like(value) if value.grad is None else value.grad for value in self._parameters]
        whole = self.averaged(torch.cat([gradient.flatten() for gradient in gradients]))
        for parameter, part in zip(self._parameters, self._split(whole), strict=True):
            parameter.grad = part

    def check(self) -> None:
        """Raise a UserError if the parameters, of a checkpoint, are not their own mirror image, up to rounding."""
        values = parameters_to_vector(self._parameters)
        if not torch.allclose(self.averaged(values), values, atol=1e-3, equal_nan=True):
            setting = "algorithm.symmetry_cfg.use_equivariant_networks=false"
            raise UserError(f"the checkpoint's networks are not equivariant: they need --set {setting}")

    def make_symmetric(self) -> None:
        """Keep one half of the parameters, of which the other half becomes the mirror image."""
        places = torch.arange(len(self.order), device=self.order.device)
        signs = torch.where(self.order < places, self.signs, 1.0)
        signs = torch.where((self.order == places) & (self.signs < 0.0), 0.0, signs)
        values = parameters_to_vector(self._parameters).index_select(0, torch.minimum(self.order, places)) * signs
        for parameter, part in zip(self._parameters, self._split(values), strict=True):
            parameter.data.copy_(part)

    def _split(self, values: Tensor) -> list[Tensor]:
        """Return numbers, one per parameter, in the shapes of the parameters."""
        parts = values.split([parameter.numel() for parameter in self._parameters])
        return [part.view_as(parameter) for part, parameter in zip(parts, self._parameters, strict=True)]


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
    network, memory = model.mlp, dict[Tensor, Map]()
    if isinstance(model, RNNModel):
        memory, inputs = _memory_maps(model.rnn.rnn, inputs)
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
    known |= memory
    deviations = outputs[0], torch.ones_like(outputs[1])
    return [known.get(parameter, deviations) for parameter in model.parameters()]


def _layer_maps(network: MLP, inputs: Map, outputs: Map) -> dict[Tensor, Map]:
    """Return the mirror images of the weights and biases of all layers."""
    maps: dict[Tensor, Map] = {}
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    for layer in layers:
        after = outputs if layer is layers[-1] else _reversed(layer.out_features, outputs)
        maps[layer.weight] = _matrix(inputs, after)
        maps[layer.bias] = inputs = after
    return maps


def _memory_maps(network: nn.RNNBase, inputs: Map) -> tuple[dict[Tensor, Map], Map]:
    """Return the mirror images of the parameters of a GRU or LSTM, and that of its outputs."""
    maps: dict[Tensor, Map] = {}
    units = _reversed(network.hidden_size, inputs)
    for layer in range(network.num_layers):
        for source, read in (("ih", inputs), ("hh", units)):
            weight, bias = (getattr(network, f"{kind}_{source}_l{layer}") for kind in ("weight", "bias"))
            maps[bias] = _joined([units] * (len(bias) // network.hidden_size))  # one behind the other: gates
            maps[weight] = _matrix(read, maps[bias])
        inputs = units
    return maps, units


def _matrix(inputs: Map, outputs: Map) -> Map:
    """Return the mirror image of a matrix, row by row."""
    order = outputs[0].unsqueeze(1) * len(inputs[0]) + inputs[0]
    return order.flatten(), (outputs[1].unsqueeze(1) * inputs[1]).flatten()


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
