"""Layout of networks: the columns of shared memory that each layer reads and writes.

A network is a list of :class:`Layer`. Where a layer reads the outputs of several others, their columns are next to each
other. All widths are multiples of :data:`ALIGNMENT`, with zeros in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from rsl_rl.modules import MLP
from torch import Tensor, nn

from legged_torque.learning.multi_head import MultiHeadMLP

ALIGNMENT = 64  # columns and rows of weights; what a matrix product reads at a time


def aligned(size: int, step: int = ALIGNMENT) -> int:
    """Return the next multiple of a step."""
    return -(-size // step) * step


@dataclass(eq=False)
class Block:
    """Rows of numbers, one per sample, in which columns are handed out."""

    width: int = 0

    def columns(self, size: int, elu: bool = False) -> Columns:
        """Hand out the next columns."""
        columns = Columns(self, self.width, size, elu)
        self.width += aligned(size)
        return columns


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns that one layer writes, or the inputs of a network."""

    block: Block
    start: int
    size: int
    elu: bool = False  # whether an ELU has been applied to them


@dataclass(frozen=True, eq=False)
class Layer:
    """A linear map from columns, all of one block and next to each other, followed by an ELU where ``target`` says."""

    linear: nn.Linear
    sources: Sequence[Columns]
    target: Columns
    first_output: int | None = None  # its first column among the outputs of all networks; None: a hidden layer

    def input_columns(self) -> Tensor:
        """Return which column of the block, from the first source on, each input is. Shape: (inputs,)."""
        start = self.sources[0].start
        return torch.cat([torch.arange(source.size) + source.start - start for source in self.sources])

    @property
    def input_width(self) -> int:
        """Columns of the inputs with the zeros between and behind them."""
        return sum(aligned(source.size) for source in self.sources)


@dataclass(eq=False)
class Network:
    """A network as layers, in the order in which they are computed."""

    inputs: Columns
    num_outputs: int
    layers: list[Layer] = field(default_factory=list)

    def outputs(self) -> list[Columns]:
        """Return where the outputs are written, in their order."""
        last = [layer for layer in self.layers if layer.first_output is not None]
        return [layer.target for layer in sorted(last, key=lambda layer: layer.first_output or 0)]

    def add(
        self, module: MLP, sources: Sequence[Columns], first_output: int | None, into: Block | None = None
    ) -> Columns:
        """Add the layers of an MLP that reads ``sources``; return what the last one writes, ``into`` a block if given.

        ``first_output`` is as in :class:`Layer`, for the last one.
        """
        linears = [part for part in module if isinstance(part, nn.Linear)]
        ends_linear = isinstance(module[-1], nn.Linear)
        for i, linear in enumerate(linears):
            is_last = i == len(linears) - 1
            block = into if into and is_last else Block()
            target = block.columns(linear.out_features, elu=not (is_last and ends_linear))
            self.layers.append(Layer(linear, sources, target, first_output if is_last else None))
            sources = [target]
        return sources[0]


def read_network(module: nn.Module, first_output: int = 0) -> Network | None:
    """Return the layers of an rsl_rl ``MLP`` or of our ``MultiHeadMLP`` with ELUs; None of any other network.

    ``first_output`` is the column of its first output among those of all networks.
    """
    parts = [part for part in module.modules() if not list(part.children())]
    if not all(isinstance(part, nn.Linear) or (isinstance(part, nn.ELU) and part.alpha == 1.0) for part in parts):
        return None
    if isinstance(module, MLP):
        first, last = module[0], module[-1]
        if not (isinstance(first, nn.Linear) and isinstance(last, nn.Linear)):
            return None
        network = Network(Block().columns(first.in_features), last.out_features)
        network.add(module, [network.inputs], first_output)
        return network
    if isinstance(module, MultiHeadMLP):
        first, positions, torques = module.trunk[0], module.position_head[-1], module.torque_head[-1]
        network = Network(Block().columns(first.in_features), positions.out_features + torques.out_features)
        seen = Block()  # by the torque head
        features = network.add(module.trunk, [network.inputs], None, seen)
        angles = network.add(module.position_head, [features], first_output, seen)
        network.add(module.torque_head, [features, angles], first_output + positions.out_features)
        return network
    return None
