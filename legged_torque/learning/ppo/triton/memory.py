"""The memory of all networks: parameters in one piece, weights as products read them, and tables of tiles."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from legged_torque.learning.ppo.triton.networks import Block, Columns, Layer, Network, aligned

SAMPLES = 128  # of a tile of a matrix product
TILE = 128  # columns of it
NUMBERS = 4  # that follow the gradients: value loss, surrogate loss, entropy, KL divergence
SAMPLES_PER_PART = 1024  # of which gradients of weights are summed up by one program, if there are not too many
MAX_PARTS = 16  # a power of two


class Parameters:
    """All parameters of actor and critic behind each other, and the weights once more as matrix products read them.

    Attributes:
        flat: The parameters; those of the modules are views of them. Shape: (parameters,).
        weights: Weights in the products' precision, each layer's with zeros up to aligned sizes. Shape: (weights,).
        source: Where in ``weights`` each parameter is, -1 for others than weights. Shape: (parameters,), int32.
        destination: Which parameter's gradient each column of :attr:`Workspace.sums` belongs to, -1 for none; the
            first ones are numbers that stand behind all gradients. Shape: (columns,), int32.
        room: Numbers that gradients of weights take.
        actor_size: Number of the actor's parameters, which come first.
    """

    def __init__(
        self,
        actor: nn.Module,
        critic: nn.Module,
        layers: Sequence[Layer],
        std_parameter: nn.Parameter,
        dtype: torch.dtype,
    ) -> None:
        """Move the parameters of both modules into one piece; ``std_parameter`` is that of the actions' deviations."""
        self._parameters = [*actor.parameters(), *critic.parameters()]
        self.flat = parameters_to_vector(self._parameters).detach()
        vector_to_parameters(self.flat, self._parameters)
        self.actor_size = sum(parameter.numel() for parameter in actor.parameters())
        device, size = self.flat.device, len(self.flat)
        source = torch.full((size,), -1, dtype=torch.int32)
        first = std_parameter.storage_offset()
        destination = [*range(size, size + NUMBERS), *range(first, first + std_parameter.numel())]
        self.place: dict[Layer, int] = {}  # of a layer's weights
        self.sum_column: dict[Columns, int] = {}  # of the sums of gradients by what a layer writes
        self.room = 0
        for layer in layers:
            linear: Any = layer.linear
            height = aligned(layer.target.size)
            self.place[layer] = self.room
            rows = torch.arange(linear.out_features).unsqueeze(1)
            first = linear.weight.storage_offset()
            index = self.room + rows * layer.input_width + layer.input_columns()
            source[first : first + index.numel()] = index.flatten().to(source.dtype)
            self.room += height * layer.input_width
            self.sum_column[layer.target] = len(destination)
            first = linear.bias.storage_offset()
            destination += [*range(first, first + linear.out_features), *[-1] * (height - linear.out_features)]
        beyond = TILE * max(layer.input_width for layer in layers)  # that a tile may read
        self.weights = torch.zeros(self.room + beyond, dtype=dtype, device=device)
        self.source = source.to(device)
        self.destination = torch.tensor(destination, dtype=torch.int32, device=device)

    def views(self, flat: Tensor) -> list[Tensor]:
        """Return what belongs to each parameter in a tensor like ``flat``."""
        parts = flat[: len(self.flat)].split([parameter.numel() for parameter in self._parameters])
        return [part.view_as(parameter) for part, parameter in zip(parts, self._parameters, strict=True)]


class Workspace:
    """Memory for the outputs of all layers for a number of samples, and tables of the tiles of their products.

    Attributes:
        rows: Samples, up to whole tiles.
        values: What all layers have computed, and inputs. Shape: (numbers,).
        outputs: Outputs of the actor, then of the critic, in float32. Shape: (rows, outputs).
        forward: A table for each stage, whose layers do not depend on each other, and whether it has outputs.
    """

    def __init__(self, networks: Sequence[Network], parameters: Parameters, num_samples: int, parts: int = 1) -> None:
        """Allocate for samples, which will be treated in ``parts`` of as many tiles each."""
        self.rows = -(-num_samples // (parts * SAMPLES)) * parts * SAMPLES
        weights, device = parameters.weights, parameters.weights.device
        self._parameters = parameters
        self._places: dict[Block, int] = {}
        room = 0
        inputs = [network.inputs.block for network in networks]
        written = [layer.target.block for network in networks for layer in network.layers]
        for block in [*dict.fromkeys(written), *inputs]:
            self._places[block] = room
            room += block.width * self.rows
        self.values = weights.new_zeros(room + TILE)  # a tile may read beyond
        self.outputs = torch.zeros(self.rows, sum(network.num_outputs for network in networks), device=device)
        self.forward = []
        for stage in stages([network.layers for network in networks]):
            has_outputs = any(layer.first_output is not None for layer in stage)
            self.forward.append((self._table(self._forward_tiles(stage)), has_outputs))

    def place(self, columns: Columns) -> int:
        """Return where columns begin in ``values`` and ``gradients``."""
        return self._places[columns.block] + columns.start

    def _table(self, tiles: list[list[int]]) -> Tensor:
        """Return tiles as a table on the device."""
        return torch.tensor(tiles, dtype=torch.int64, device=self.values.device)

    def _forward_tiles(self, layers: Sequence[Layer]) -> list[list[int]]:
        """Return the tiles of layers for the kernel ``forward``."""
        tiles = []
        for layer in layers:
            source, target = layer.sources[0], layer.target
            weights = self._parameters.place[layer]
            bias = int(layer.linear.bias.storage_offset())
            for first in range(0, aligned(target.size), TILE):
                output = -1 if layer.first_output is None else layer.first_output + first
                read = [self.place(source), source.block.width, layer.input_width]
                read += [weights + first * layer.input_width, layer.input_width]
                written = [self.place(target) + first, target.block.width]
                sizes = [aligned(target.size) - first, target.size - first]
                tiles.append([*read, *written, *sizes, bias + first, int(target.elu), output, self.outputs.shape[1]])
        return tiles


class LearningWorkspace(Workspace):
    """The same with room for gradients.

    Attributes:
        gradients: Gradients of the loss by the values, except for the inputs. Shape: (numbers,).
        backward: A table for each stage of gradients of what layers read.
        weight_tiles: The table for gradients of weights.
        partial: Room for these gradients from each part of the samples. Shape: (parts, ``room``).
        sums: Room for sums over the samples of a tile: numbers, then gradients. Shape: (tiles, columns).
    """

    def __init__(self, networks: Sequence[Network], parameters: Parameters, num_samples: int) -> None:
        """Allocate for samples."""
        parts = MAX_PARTS
        while parts > 1 and num_samples < parts * SAMPLES_PER_PART:
            parts //= 2
        super().__init__(networks, parameters, num_samples, parts)
        inputs = min(self.place(network.inputs) for network in networks)  # which stand behind all else
        self.gradients = parameters.weights.new_zeros(inputs + TILE)
        self.backward = [self._table(tiles) for tiles in self._backward_tiles(networks)]
        layers = [layer for network in networks for layer in network.layers]
        self.weight_tiles = self._table([tile for layer in layers for tile in self._weight_tiles(layer)])
        device = self.values.device
        self.partial = torch.zeros(parts, parameters.room, device=device)
        self.sums = torch.zeros(self.rows // SAMPLES, len(parameters.destination), device=device)

    def output_places(self, networks: Sequence[Network]) -> Tensor:
        """Return where the gradient by each output of the networks begins, its stride and its column of ``sums``.

        Shape: (3, outputs), int64.
        """
        places = []
        for network in networks:
            for target in network.outputs():
                first, column = self.place(target), self._parameters.sum_column[target]
                places += [(first + i, target.block.width, column + i) for i in range(target.size)]
        return torch.tensor(places, device=self.values.device).T.contiguous()

    def _backward_tiles(self, networks: Sequence[Network]) -> list[list[list[int]]]:
        """Return the tiles of all stages for the kernel ``input_gradient``."""
        result = []
        there = {layer.target for network in networks for layer in network.layers if layer.first_output is not None}
        first_reader: dict[Columns, Layer] = {}
        for network in networks:
            for layer in network.layers:
                for source in layer.sources:
                    first_reader.setdefault(source, layer)
        inputs = [network.inputs for network in networks]
        chains = [
            [layer for layer in reversed(network.layers) if layer.sources[0] not in inputs] for network in networks
        ]
        for stage in stages(chains):
            tiles = []
            for layer in stage:
                offset = 0
                for source in layer.sources:
                    for first in range(0, aligned(source.size), TILE):
                        read = [self.place(layer.target), layer.target.block.width, aligned(layer.target.size)]
                        read += [self._parameters.place[layer] + offset + first, layer.input_width]
                        ends = source.elu and first_reader[source] is layer
                        sizes = [aligned(source.size) - first, self._parameters.sum_column[source] + first]
                        written = [self.place(source) + first, source.block.width, *sizes]
                        adds = source.size - first if source in there else 0
                        tiles.append([*read, *written, adds, int(ends)])
                    offset += aligned(source.size)
                    there.add(source)
            result.append(tiles)
        return result

    def _weight_tiles(self, layer: Layer) -> list[list[int]]:
        """Return the tiles of a layer for the kernel ``weight_gradient``."""
        tiles = []
        source, target = layer.sources[0], layer.target
        for row in range(0, aligned(target.size), TILE):
            for column in range(0, layer.input_width, TILE):
                read = [self.place(target) + row, target.block.width, aligned(target.size) - row]
                read += [self.place(source) + column, source.block.width, layer.input_width - column]
                place = self._parameters.place[layer] + row * layer.input_width + column
                tiles.append([*read, place, layer.input_width])
        return tiles


def stages(chains: Sequence[Sequence[Layer]]) -> list[list[Layer]]:
    """Return what can be computed at once: the first layers of all chains, then the second ones, and so on."""
    return [[layer for layer in stage if layer] for stage in zip_longest(*chains)]
