"""The memory of actor and critic: parameters in one piece, room for what layers compute, and tables of tiles."""

from collections.abc import Iterable, Sequence
from itertools import chain, zip_longest
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from legged_torque.learning.ppo.triton.networks import Block, Columns, Layer, aligned

SAMPLES = 128  # of a tile of a matrix product
TILE = 128  # columns of it
NARROW_TILE = 64  # of gradients of what layers read, and of layers that are no wider
LOSS_SAMPLES = 16  # of a program that computes losses; with 128 it takes twice as long
NUMBERS = 4  # that follow the gradients: value loss, surrogate loss, entropy, KL divergence
SAMPLES_PER_PART = 1024  # of which gradients of weights are summed up by one program, if there are not too many
MAX_PARTS = 6  # with the default networks, an H100 computes all tiles of so many parts at once


class Memory:
    """All numbers of actor and critic, and tables of the tiles of their matrix products.

    Acting uses the first rows of what is there for learning.

    Attributes:
        inputs: The columns of the inputs of the actor and of the critic.
        flat: The parameters, the actor's first; those of the modules are views of them. Shape: (parameters,).
        actor_size: Number of the actor's parameters.
        weights: Weights in the products' precision, each layer's with zeros up to aligned sizes. Shape: (numbers,).
        source: Where in ``weights`` each parameter is, -1 for others than weights. Shape: (parameters,), int32.
        loss_destination: Which gradient each column of ``loss_sums`` belongs to, -1 for none; the first ones are
            numbers that stand behind all gradients. Shape: (columns,), int32.
        destination: Which gradient each column of ``sums`` belongs to, -1 for none. Shape: (columns,), int32.
        rows: Samples of a minibatch, up to whole tiles.
        values: Inputs, and what all layers have computed. Shape: (numbers,).
        outputs: Outputs of the actor, then of the critic, in float32. Shape: (rows, outputs).
        gradients: Gradients of the loss by the values, except for the inputs. Shape: (numbers,).
        partial: Room for gradients of weights from each part of the samples. Shape: (parts, numbers).
        loss_sums: Room for sums over a few samples: numbers, then gradients by deviations and outputs.
            Shape: (rows / LOSS_SAMPLES, columns).
        sums: Room for sums over the samples of a tile: gradients by what layers read. Shape: (tiles, columns).
        forward: For each stage, whose layers do not depend on each other, a table, the tiles' columns, and whether
            it has outputs.
        backward: A table for each stage of gradients of what layers read.
        weight_tiles: The table for gradients of weights.
    """

    def __init__(
        self,
        models: Sequence[nn.Module],
        networks: Sequence[Sequence[Layer]],
        std_parameter: nn.Parameter,
        dtype: torch.dtype,
        num_samples: int,
        num_envs: int,
    ) -> None:
        """Move the parameters of actor and critic into one piece, and allocate for samples and for worlds.

        ``std_parameter`` is that of the actions' deviations; ``dtype`` is that of the products.
        """
        self._networks = networks
        self._layers = [layer for network in networks for layer in network]
        self._outputs = [layer.target for layer in self._layers if layer.first_output is not None]
        self.inputs = [network[0].sources[0] for network in networks]
        self._parameters = [parameter for model in models for parameter in model.parameters()]
        self.flat = parameters_to_vector(self._parameters).detach()
        vector_to_parameters(self.flat, self._parameters)
        self.actor_size = sum(parameter.numel() for parameter in models[0].parameters())
        room = self._place_weights(std_parameter)
        beyond = TILE * max(layer.input_width for layer in self._layers)  # that a tile may read
        device = self.flat.device
        self.weights = torch.zeros(room + beyond, dtype=dtype, device=device)
        parts = MAX_PARTS
        while parts > 1 and num_samples < parts * SAMPLES_PER_PART:
            parts //= 2
        self.rows = aligned(num_samples, parts * SAMPLES)
        all_rows = max(self.rows, aligned(num_envs, SAMPLES))
        self._places: dict[Block, int] = {}
        end = 0
        written = [layer.target.block for layer in self._layers]
        for block in dict.fromkeys([*written, *(inputs.block for inputs in self.inputs)]):
            self._places[block] = end
            end += block.width * all_rows
        self.values = self.weights.new_zeros(end + TILE)  # a tile may read beyond
        self.outputs = torch.zeros(all_rows, sum(target.size for target in self._outputs), device=device)
        first_input = min(map(self.place, self.inputs))  # which stand behind all else
        self.gradients = self.weights.new_zeros(first_input + TILE)
        self.partial = torch.zeros(parts, room, device=device)
        self.loss_sums = torch.zeros(self.rows // LOSS_SAMPLES, len(self.loss_destination), device=device)
        self.sums = torch.zeros(self.rows // SAMPLES, len(self.destination), device=device)
        self.forward = [self._forward_table(stage) for stage in stages(networks)]
        self.backward = self._backward_tables()
        self.weight_tiles = self._table(map(self._weight_tiles, self._layers))

    def views(self, flat: Tensor) -> list[Tensor]:
        """Return what belongs to each parameter in a tensor like ``flat``."""
        parts = flat[: len(self.flat)].split([parameter.numel() for parameter in self._parameters])
        return [part.view_as(parameter) for part, parameter in zip(parts, self._parameters, strict=True)]

    def place(self, columns: Columns) -> int:
        """Return where columns begin in ``values`` and ``gradients``."""
        return self._places[columns.block] + columns.start

    def output_places(self) -> Tensor:
        """Return where the gradient by each output of the networks begins, and its stride.

        Shape: (2, outputs), int64.
        """
        places = [(self.place(to) + i, to.block.width) for to in self._outputs for i in range(to.size)]
        return torch.tensor(places, device=self.flat.device).T.contiguous()

    def _place_weights(self, std_parameter: nn.Parameter) -> int:
        """Set ``source`` and both destinations; return how many numbers weights take."""
        size, room = len(self.flat), 0
        source = torch.full((size,), -1, dtype=torch.int32)
        first = std_parameter.storage_offset()
        of_losses = [*range(size, size + NUMBERS), *range(first, first + std_parameter.numel())]
        destination: list[int] = []
        self._weight_places: dict[Layer, int] = {}
        self._sum_columns: dict[Columns, int] = {}  # of gradients by what a layer writes and another one reads
        read = {source for layer in self._layers for source in layer.sources}
        for layer in self._layers:
            linear: Any = layer.linear
            height = aligned(linear.out_features)
            rows = torch.arange(linear.out_features).unsqueeze(1)
            index = room + rows * layer.input_width + layer.input_columns()
            first = linear.weight.storage_offset()
            source[first : first + index.numel()] = index.flatten().to(source.dtype)
            self._weight_places[layer] = room
            room += height * layer.input_width
            first = linear.bias.storage_offset()
            biases = [*range(first, first + linear.out_features)]
            if layer.target in read:
                self._sum_columns[layer.target] = len(destination)
                destination += [*biases, *[-1] * (height - len(biases))]
            if layer.first_output is not None:
                of_losses += [-1] * len(biases) if layer.target in read else biases
        self.source = source.to(self.flat.device)
        self.loss_destination, self.destination = (
            torch.tensor(columns, dtype=torch.int32, device=self.flat.device) for columns in (of_losses, destination)
        )
        return room

    def _table(self, tiles: Iterable[list[list[int]]]) -> Tensor:
        """Return the tiles of several layers as a table on the device."""
        return torch.tensor([*chain.from_iterable(tiles)], dtype=torch.int64, device=self.flat.device)

    def _forward_table(self, stage: Sequence[Layer]) -> tuple[Tensor, int, bool]:
        """Return an entry of ``forward``."""
        tile = TILE if any(layer.target.size > NARROW_TILE for layer in stage) else NARROW_TILE
        has_outputs = any(layer.first_output is not None for layer in stage)
        return self._table(self._forward_tiles(layer, tile) for layer in stage), tile, has_outputs

    def _forward_tiles(self, layer: Layer, tile: int) -> list[list[int]]:
        """Return the tiles of a layer for the kernel ``forward``."""
        tiles = []
        source, target, weights = layer.sources[0], layer.target, self._weight_places[layer]
        bias = int(layer.linear.bias.storage_offset())
        for first in range(0, aligned(target.size), tile):
            output = -1 if layer.first_output is None else layer.first_output + first
            read = [self.place(source), source.block.width, layer.input_width]
            read += [weights + first * layer.input_width, layer.input_width]
            written = [self.place(target) + first, target.block.width]
            sizes = [aligned(target.size) - first, target.size - first]
            tiles.append([*read, *written, *sizes, bias + first, int(target.elu), output, self.outputs.shape[1]])
        return tiles

    def _backward_tables(self) -> list[Tensor]:
        """Return the tables of all stages for the kernel ``input_gradient``."""
        there = set(self._outputs)
        last = {source: layer for layer in reversed(self._layers) for source in layer.sources}  # to add a gradient
        backward = [list(reversed(network[1:])) for network in self._networks]  # nothing needs that of the inputs
        tables = []
        for stage in stages(backward):
            tiles = []
            for layer in stage:
                offset = 0
                for source in layer.sources:
                    for first in range(0, aligned(source.size), NARROW_TILE):
                        read = [self.place(layer.target), layer.target.block.width, aligned(layer.target.size)]
                        read += [self._weight_places[layer] + offset + first, layer.input_width]
                        sizes = [aligned(source.size) - first, self._sum_columns[source] + first]
                        written = [self.place(source) + first, source.block.width, *sizes]
                        adds = source.size - first if source in there else 0
                        tiles.append([*read, *written, adds, int(source.elu and last[source] is layer)])
                    offset += aligned(source.size)
                    there.add(source)
            tables.append(self._table([tiles]))
        return tables

    def _weight_tiles(self, layer: Layer) -> list[list[int]]:
        """Return the tiles of a layer for the kernel ``weight_gradient``."""
        tiles = []
        source, target = layer.sources[0], layer.target
        for row in range(0, aligned(target.size), TILE):
            for column in range(0, layer.input_width, TILE):
                read = [self.place(target) + row, target.block.width, aligned(target.size) - row]
                read += [self.place(source) + column, source.block.width, layer.input_width - column]
                place = self._weight_places[layer] + row * layer.input_width + column
                tiles.append([*read, place, layer.input_width])
        return tiles


def stages(chains: Sequence[Sequence[Layer]]) -> list[list[Layer]]:
    """Return what can be computed at once: the first layers of all chains, then the second ones, and so on."""
    return [[layer for layer in stage if layer] for stage in zip_longest(*chains)]
